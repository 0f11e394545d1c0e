"""The project that the app works on: its folder, its runs, and what pages share."""
