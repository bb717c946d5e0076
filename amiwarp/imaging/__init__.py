"""Images of warped events (IWE), their sharpness and their metrics."""
