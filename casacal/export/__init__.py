"""A calibrated arm in the forms that others read: each function takes a result of `read_result` and returns text.

The estimate is exported as it stands in the result: directions that the samples did not determine stay where the prior
held them. Each form that has comments says what tip error to expect.
"""
