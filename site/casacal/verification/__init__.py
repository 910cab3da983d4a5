"""Verification: fresh rows, judged without fitting the arm again."""
