"""Named worlds: scenes made by a program, which need no files."""
