"""The Python interface: tables and names as arguments, objects as results."""
