"""What one run is made of: its flags, its plan, the loop over chunks, what it says of itself, and going on with it."""
