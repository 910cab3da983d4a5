"""What pages are made of: templates, numbers, and pictures as inline SVG."""
