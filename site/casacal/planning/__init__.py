"""Which measurements to make: the postures that tell most of where the tip will be wanted."""
