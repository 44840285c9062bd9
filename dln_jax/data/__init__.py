"""Recordings and robot files: the file schema, readers, checks, filters and splits."""
