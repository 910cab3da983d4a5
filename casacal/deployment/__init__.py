"""A calibrated arm in use: results, predictions, compensated targets, and exports."""
