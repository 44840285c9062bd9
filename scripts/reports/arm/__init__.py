"""The two-link arm that writes letters."""
