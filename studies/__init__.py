"""One file a question; each runs as python -m studies.NAME and writes a report beside itself."""
