"""Command lines: options, help, checks, folders, launchers; what every command shares."""
