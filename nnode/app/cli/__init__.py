"""Shared parts of the commands: options, help, checks, folders and launchers."""
