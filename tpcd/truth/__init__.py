"""Where simulated episodes come from: independent truths, scenes, motions."""
