"""Networks as functions of x, without physics."""
