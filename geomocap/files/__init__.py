"""The two folders, capture and run, and everything that is read from files or written to them."""
