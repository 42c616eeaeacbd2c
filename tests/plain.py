"""What several tests write a second time, plainly and without the library."""


def rk4(rate, x, h):
    """One Runge–Kutta step of fourth order of `x' = rate(x)`."""
    a = rate(x)
    b = rate(x + h / 2 * a)
    c = rate(x + h / 2 * b)
    return x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))
