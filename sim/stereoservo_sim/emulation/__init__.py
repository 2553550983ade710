"""What every emulator has: a console for orders, and life as a child process."""
