"""The work itself: unit after unit from the engine into the file."""
