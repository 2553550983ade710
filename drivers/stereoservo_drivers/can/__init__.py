"""CAN transports: frames, their bits on the wire, fast serial-line CAN."""
