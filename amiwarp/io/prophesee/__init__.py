"""Prophesee's RAW and DAT files, and the decoders of their words."""
