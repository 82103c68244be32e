"""Live sessions, in which a person presses the tissue. The window gives the session events and gets pictures."""
