"""Translation of pictures and of recordings of plain event cameras to recordings through the prism."""
