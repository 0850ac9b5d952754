"""One module per command: from input files to output files."""
