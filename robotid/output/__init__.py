"""What is written and shown: files, pages, reports, the viewer."""
