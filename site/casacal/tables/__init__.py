"""Tables: delimited text, workbooks, arrays, a million rows."""
