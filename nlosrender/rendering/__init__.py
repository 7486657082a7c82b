"""The work itself: work item after work item from the engine into the file."""
