"""Live: a person presses the tissue. The session is one half, the window the other; they share events and pictures."""
