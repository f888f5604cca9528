"""Shapes: latent to signed distance and outline, outlines from files, built-in outlines."""
