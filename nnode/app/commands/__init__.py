"""The commands, one file each. ``--help`` shows its docstring."""
