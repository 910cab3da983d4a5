"""What a plan becomes to take along: moves for a controller, a sheet to write on, set-ups to choose from."""
