"""What an arm is built from: a Denavit-Hartenberg table, screws, or a URDF; values, and files to read them from."""
