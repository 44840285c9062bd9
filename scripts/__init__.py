"""Command lines: thin layers from arguments to library calls to files and figures."""
