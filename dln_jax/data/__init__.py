"""Data: the file schema, readers and splits."""
