"""Whether models know what they do not know: coverage of their bands on held-out motions, and flags of far states."""
