"""Imports what configures logging before a test does: it closes all handlers, those of pytest's captures too."""

import contextlib

with contextlib.suppress(ImportError):
    import submitit  # noqa: F401
