"""Car following: pairs with published results, platoons, people behind automated cars."""
