"""Where a model is wrong: curves of what it leaves, without a formula."""
