"""Training of the shape priors: outlines in, `checkpoints/NAME` out."""
