"""The interactive viewer: recordings, events and their compensation in a browser."""
