"""The scene's log brightness from pairs of events: equations, solver, residuals."""
