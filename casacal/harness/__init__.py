"""What a study needs besides its description: counting, keys, records, executors, statistics."""
