"""Building blocks of pages: templates, numbers, and pictures as inline SVG."""
