"""One file per question; each runs as python -m studies.NAME and writes a report beside itself."""
