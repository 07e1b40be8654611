"""What users of Python meet: tables and names in, objects out."""
