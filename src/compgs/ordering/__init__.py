"""Order of the anchors, their ranges (levels of detail) and their neighbours. All of it follows from the positions."""
