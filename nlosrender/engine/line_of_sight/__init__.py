"""Line-of-sight captures: what a camera sees of a scene that emits one pulse, over time."""
