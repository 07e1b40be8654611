"""People in the plane, in compiled code."""
