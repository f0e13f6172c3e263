"""The command line: run files in, run folders out."""
