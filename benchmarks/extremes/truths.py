"""Closed forms in 50 digits, each from its source and none from the code under test.

Numbers go in as float64 holds them; what comes out is rounded once, at the end, by whoever compares.
"""

from mpmath import matrix, mp, mpc, mpf

mp.dps = 50
C = mpf(299792458)  # [m/s], exact (SI)
EPS0 = mpf("8.8541878188e-12")  # [F/m], CODATA 2022

Pair = tuple[mpc, mpc]  # (TE, TM), equal at normal incidence


def friis(frequency: float, length: mpf) -> mpc:
    """lambda / (4 pi d) exp(-j k d): Friis (1946), time convention exp(+j 2 pi f t)."""
    return C / (4 * mp.pi * mpf(frequency) * length) * phase(frequency, length)


def phase(frequency: float, length: mpf) -> mpc:
    """exp(-j 2 pi f d / c)."""
    return mp.expjpi(-2 * mp.frac(mpf(frequency) * length / C))


def distance(a: tuple[float, ...], b: tuple[float, ...]) -> mpf:
    return mp.sqrt(sum((mpf(x) - mpf(y)) ** 2 for x, y in zip(a, b, strict=True)))


def permittivity(eps_r: float, sigma: float, frequency: float) -> mpc:
    """eps_r - j sigma / (2 pi f eps_0) (ITU-R P.2040-4 section 2.1.1)."""
    return mpc(eps_r, -mpf(sigma) / (2 * mp.pi * mpf(frequency) * EPS0))


def fresnel(cosine: mpf, eps: mpc) -> Pair:
    """Textbook coefficients (Balanis 2012, section 5.3), the sign of TM as the contract has it."""
    root = mp.sqrt(eps - (1 - cosine**2))
    te = (cosine - root) / (cosine + root)
    tm = (eps * cosine - root) / (eps * cosine + root)
    return te, -tm


def slab(cosine: mpf, eps: mpc, thickness: float, frequency: float) -> tuple[Pair, Pair]:
    """R and T of one layer by its characteristic matrix (Born and Wolf, section 1.6.2); T relative
    to free space over the thickness."""
    k, d = 2 * mp.pi * mpf(frequency) / C, mpf(thickness)
    root = mp.sqrt(eps - (1 - cosine**2))
    delta = k * d * root
    found = []
    for p0, p1 in ((cosine, root), (cosine, root / eps)):
        layer = matrix(
            [[mp.cos(delta), 1j * mp.sin(delta) / p1], [1j * p1 * mp.sin(delta), mp.cos(delta)]]
        )
        b, c = layer * matrix([1, p0])
        found.append(((p0 * b - c) / (p0 * b + c), 2 * p0 / (p0 * b + c)))
    lead = mp.exp(1j * k * d * cosine)  # what free space would have done on the way
    (te_r, te_t), (tm_r, tm_t) = found
    return (te_r, tm_r), (te_t * lead, tm_t * lead)


def slab_delay(cosine: mpf, eps_r: float, sigma: float, thickness: float, frequency: float) -> mpf:
    """-(1 / 2 pi) d arg T / df of the TE wave: group delay beyond free space [s]."""

    def log_t(f: mpf) -> mpc:
        return mp.log(slab(cosine, permittivity(eps_r, sigma, f), thickness, f)[1][0])

    h = mpf(frequency) * mpf(10) ** -15
    at = mpf(frequency)
    turn = mp.im(log_t(at + h) - log_t(at - h))
    turn -= 2 * mp.pi * mp.nint(turn / (2 * mp.pi))  # the logarithm's own cut
    return -turn / (4 * mp.pi * h)


def scalar(pair: Pair) -> mpc:
    """Unpolarised: mean power of TE and TM with the phase of TE (docs/conventions.md)."""
    te, tm = pair
    return mp.sqrt((abs(te) ** 2 + abs(tm) ** 2) / 2) * te / abs(te)


def sphere(radius: float, away: float, half_angle: float) -> tuple[mpf, mpf, mpf]:
    """(length, spreading, cosine) of the glint on a ball between two points that stand ``away`` from
    its centre, ``half_angle`` [rad] to either side of the glint.

    Spreading of a spherical wave reflected by a sphere: Kouyoumjian and Pathak (1974), Eqs. 10-17,
    with both radii of curvature ``radius``.
    """
    a, r, beta = mpf(radius), mpf(away), mpf(half_angle)
    d = mp.sqrt(a**2 + r**2 - 2 * a * r * mp.cos(beta))
    cosine = (r * mp.cos(beta) - a) / d
    across = 2 * d + 2 * d * d * cosine / a
    within = 2 * d + 2 * d * d / (a * cosine)
    return 2 * d, 1 / mp.sqrt(across * within), cosine


def mie_backscatter(radius: float, frequency: float) -> mpf:
    """Radar cross section of a metal ball over pi a^2 (Mie 1908; Bowman, Senior and Uslenghi 1969,
    section 10.4): 1 where rays describe it."""
    x = 2 * mp.pi * mpf(frequency) * mpf(radius) / C
    total = mpf(0)
    for n in range(1, int(x + 4 * x ** (mpf(1) / 3) + 12)):
        j, before = _spherical(n, x), _spherical(n - 1, x)
        b = -j.real / j  # j_n / h_n
        a = -(x * before.real - n * j.real) / (x * before - n * j)  # (x j_n)' / (x h_n)'
        total += (-1) ** n * (2 * n + 1) * (a - b)
    return abs(total) ** 2 / x**2


def _spherical(n: int, x: mpf) -> mpc:
    """h_n^(2) = j_n - j y_n."""
    scale = mp.sqrt(mp.pi / (2 * x))
    return scale * mpc(mp.besselj(n + mpf(1) / 2, x), -mp.bessely(n + mpf(1) / 2, x))


# the paper's stochastic transport, at one place and through a plate


def occupancy(law: str, u: mpf) -> mpf:
    """o = Psi(-u) of the three laws (paper, Eqs. 17 and 18)."""
    if law == "logistic":
        return 1 / (1 + mp.exp(u))
    if law == "gaussian":
        return mp.erfc(u / mp.sqrt(2)) / 2
    return mp.exp(-u) / 2 if u >= 0 else 1 - mp.exp(u) / 2


def hazard(law: str, u: mpf) -> mpf:
    """psi(u) / Psi(-u)."""
    density = {
        "logistic": occupancy("logistic", u) * occupancy("logistic", -u),
        "gaussian": mp.exp(-(u**2) / 2) / mp.sqrt(2 * mp.pi),
        "laplace": mp.exp(-abs(u)) / 2,
    }
    return density[law] / occupancy(law, u)


def stochastic_reflection(
    law: str, s: float, m: float, alpha: float, cosine: mpf, length: float
) -> mpf:
    """exp(-a_out l) on the boundary, |grad f| = 1, phi = 0 (paper, Eqs. 14 and 16)."""
    mix = mpf(alpha) * cosine + (1 - mpf(alpha)) / 2
    return mp.exp(-(mpf(m) / 2 + 1) * mpf(s) * hazard(law, mpf(0)) * mix * mpf(length))


def stochastic_plate(
    law: str, s: float, m: float, alpha: float, cosine: mpf, thickness: float, length: float
) -> mpf:
    """T of a plate, boundaries included, phi = 0. Towards the middle f falls and then rises with
    slope 1, so both integrals of Eq. 19 are differences of ln o and of o."""
    deep = occupancy(law, -mpf(s) * mpf(thickness) / 2)
    shallow = occupancy(law, mpf(0))
    one_way = mpf(m) * (deep - shallow) + mp.log(deep / shallow)
    mix = mpf(alpha) + (1 - mpf(alpha)) / (2 * cosine)
    r = stochastic_reflection(law, s, m, alpha, cosine, length)
    return mp.exp(-2 * one_way * mix) * (1 - r**2)
