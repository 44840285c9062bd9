"""Hard cases: measured values compared with theory."""
