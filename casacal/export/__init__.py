"""A calibrated arm in the forms that others read: each function takes a result of `read_result` and returns text.

The estimate is exported as it stands in the result: directions that the samples did not determine stay where the prior
held them. Each form that has comments says what tip error to expect.
"""

from casacal.export.controllers import ZeroCorrections, ur_kinematics_text, urdf_text, zero_corrections, zeros_text
from casacal.export.forms import dh_text
from casacal.export.functions import c_text
from casacal.export.remark import remark

__all__ = [
    "ZeroCorrections",
    "c_text",
    "dh_text",
    "remark",
    "ur_kinematics_text",
    "urdf_text",
    "zero_corrections",
    "zeros_text",
]
