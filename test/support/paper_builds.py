"""The paper's Table 1 and its range equation with 50 digits."""

import mpmath
import numpy as np

# k' px, b' px as printed, R_near mm, R_far mm, row of R_far (the print's own convention).
TABLE_1 = {
    "nominal": ("-36510.29", "-1084.00", 810.45, 2413.54, 720),
    "config_1": ("-32409.56", "-1086.04", 718.07, 2124.69, 719),
    "config_2": ("-37413.82", "-1075.30", 837.23, 2526.73, 719),
    "config_3": ("-37261.86", "-1142.74", 784.61, 2115.93, 719),
}


def exact_k_mm() -> mpmath.mpf:
    """Return ``f / sin(theta)`` of all builds; call within ``mpmath.workdps``."""
    return mpmath.mpf(24) / mpmath.sin(mpmath.radians(mpmath.mpf("85.87")))


def exact_range_mm(build: str, rows: np.ndarray) -> list[mpmath.mpf]:
    """Return Eq. 2 from the decimal numbers of the table; call within ``mpmath.workdps``."""
    k_prime, b_prime = (mpmath.mpf(text) for text in TABLE_1[build][:2])
    return [exact_k_mm() * k_prime / (int(row) + b_prime) for row in rows]
