"""The technical report: its text, and the program that builds it from the committed results."""
