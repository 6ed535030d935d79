"""Where markers are on their segments, learned from movements, and what that is worth."""
