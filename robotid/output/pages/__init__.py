"""What every page is made of: the document, its style, tables and charts."""
