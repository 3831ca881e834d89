"""Where the parts of a picture go, and pictures and tables as notebooks show them; no nets, no matplotlib."""
