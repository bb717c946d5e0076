"""Text files of events: the format of the Event Camera Dataset, and tables."""
