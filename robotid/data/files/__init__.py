"""Files of recordings: tables, arrays, bags and data sets, read into logs."""
