"""Studies: thin compositions of the library that answer one question each."""
