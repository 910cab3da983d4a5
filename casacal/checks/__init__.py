"""The data doctor: what is wrong with samples, in words, before anyone trusts a fit."""
