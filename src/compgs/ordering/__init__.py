"""In which order anchors come, which of them come together, and which came before around each: from positions alone."""
