"""What the two fits ended with: `python -m maxq.tools.dev.ksr3.build --refit` prints these numbers anew.

They are kept because a fit by finite differences ends elsewhere on another processor (7e-5 of the parameters, seen):
the vehicle's tables should not. tests/test_reference_ksr3_data.py fits again and compares.
"""

from __future__ import annotations

# chamber pressure last over first, vacuum Isp s, drag scale, turn rad, base drag in coast (trajectory.fit_to_table_1)
TABLE_1 = (0.7279038693829383, 234.85892768738503, 1.1499999999880992, 0.21576459446422408, 0.06802120243919793)

# CN_alpha of the fins, their station, Mach sensitivity, scale of the supersonic shift (aerodynamics.fit_to_table_2)
TABLE_2 = (17.424165974008826, 11.058988242832239, 0.8430591321730815, 0.9900593357557127)
