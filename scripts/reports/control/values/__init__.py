"""Value functions of published plants: what is controlled, the truth beside them, and what their policies cost."""
