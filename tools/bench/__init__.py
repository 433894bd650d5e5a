"""`podwatch bench`: measure what is promised, and print every figure beside its bar."""
