"""Car following: pairs with published results, platoons on a track, people behind automated cars."""
