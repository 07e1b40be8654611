"""The commands: one file each, whose docstring ``--help`` shows."""
