"""Photo and synthetic camera image brought together without picks: the loop, its matches, and what they are worth."""
