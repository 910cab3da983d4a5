"""Measuring at the machine: touches taken one by one, each judged as it is made, and gauges."""
