"""What the page says, one file per section; numbers are those of result.json."""
