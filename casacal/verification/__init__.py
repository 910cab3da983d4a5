"""Verification: fresh rows judged without refitting the arm."""
