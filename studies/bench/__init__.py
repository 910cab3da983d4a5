"""The public sets of `casacal bench`, and the methods that it compares on them."""
