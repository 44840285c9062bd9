"""What a user's file is: the schema, its reading and its splits."""
