"""A diagnosis as files, a page and figures."""
