"""How fast, how right and how hard to break nnode is: run from the repository, never installed."""
