"""Planning: the touches that tell most of where the tip will be wanted, their route, and advice after a fit."""
