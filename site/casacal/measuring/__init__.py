"""A session at the machine: touches taken in one by one, each judged when it is made."""
