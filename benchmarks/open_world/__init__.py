"""The diagnosis where the base law is wrong: worlds that neither it nor its catalogue made."""
