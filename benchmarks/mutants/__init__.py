"""Small faults that are put into the package, and whether its tests notice them."""
