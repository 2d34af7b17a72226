"""Numba kernels over plain arrays: kinematics, closed-form fields, collision tests and path search.

Loaded only where a field and a robot offer what they need, since importing numba takes time.
"""
