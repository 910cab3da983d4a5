"""Problems: a robot with its instruments, compiled to functions of one row; the files that define them."""
