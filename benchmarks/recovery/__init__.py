"""Parameters that are typed into other programs, recovered from what these simulate."""
