"""What the reports measure."""
