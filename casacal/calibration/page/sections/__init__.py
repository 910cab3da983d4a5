"""What the page says, a file a section; numbers are those of result.json."""
