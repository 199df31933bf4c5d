"""Normalised fal: e within +-delta, else sign(e) delta (\\|e\\| / delta)^alpha.

The normalised form is continuous with slope 1 in its linear zone. `e` and `delta` share one LSB, which is the
result's. Outside the zone it is delta 2^(alpha log2(\\|e\\| / delta)), both functions straight lines between
128 points of an octave: the real power to 1e-5, rounded down; delta at delta, odd, monotonic because every
step is, never beyond \\|e\\|.
"""

from dbc.machine import clz, i32, i64, int32
from firmware_py.kernel.fixedpoint import INT32_MAX, INT32_MIN

# fmt: off
LOG2 = (  # 2^22 log2(1 + n / 128)
    0, 47091, 93817, 140186, 186202, 231871, 277198, 322188, 366846, 411176, 455185, 498875, 542252, 585321,
    628085, 670549, 712717, 754593, 796182, 837487, 878511, 919259, 959735, 999942, 1039883, 1079563, 1118984,
    1158150, 1197064, 1235729, 1274149, 1312326, 1350264, 1387966, 1425434, 1462672, 1499682, 1536467,
    1573029, 1609372, 1645499, 1681410, 1717110, 1752600, 1787884, 1822963, 1857840, 1892517, 1926996,
    1961280, 1995371, 2029270, 2062981, 2096506, 2129845, 2163002, 2195978, 2228775, 2261396, 2293842,
    2326114, 2358216, 2390148, 2421912, 2453511, 2484945, 2516217, 2547328, 2578280, 2609074, 2639713,
    2670197, 2700529, 2730709, 2760739, 2790621, 2820356, 2849946, 2879392, 2908695, 2937857, 2966879,
    2995763, 3024509, 3053120, 3081595, 3109938, 3138148, 3166228, 3194177, 3221999, 3249692, 3277260,
    3304703, 3332022, 3359218, 3386292, 3413246, 3440080, 3466796, 3493394, 3519876, 3546242, 3572494,
    3598633, 3624659, 3650574, 3676379, 3702073, 3727659, 3753138, 3778509, 3803775, 3828935, 3853992,
    3878945, 3903795, 3928544, 3953192, 3977740, 4002189, 4026540, 4050793, 4074949, 4099009, 4122974,
    4146844, 4170621, 4194304,
)
EXP2 = (  # 2^22 2^(n / 128)
    4194304, 4217079, 4239977, 4263000, 4286147, 4309421, 4332820, 4356347, 4380002, 4403785, 4427697,
    4451739, 4475911, 4500215, 4524651, 4549219, 4573921, 4598757, 4623728, 4648834, 4674077, 4699457,
    4724974, 4750630, 4776426, 4802361, 4828438, 4854656, 4881016, 4907519, 4934167, 4960959, 4987896,
    5014980, 5042211, 5069589, 5097117, 5124794, 5152621, 5180599, 5208729, 5237012, 5265449, 5294039,
    5322786, 5351688, 5380747, 5409964, 5439339, 5468874, 5498570, 5528427, 5558445, 5588627, 5618973,
    5649483, 5680159, 5711002, 5742012, 5773191, 5804539, 5836057, 5867746, 5899607, 5931642, 5963850,
    5996233, 6028792, 6061528, 6094441, 6127533, 6160805, 6194258, 6227892, 6261709, 6295709, 6329894,
    6364265, 6398822, 6433567, 6468501, 6503624, 6538938, 6574444, 6610143, 6646035, 6682122, 6718406,
    6754886, 6791564, 6828442, 6865520, 6902799, 6940280, 6977965, 7015855, 7053950, 7092253, 7130763,
    7169482, 7208412, 7247553, 7286906, 7326473, 7366255, 7406253, 7446469, 7486902, 7527555, 7568429,
    7609525, 7650844, 7692387, 7734156, 7776152, 7818376, 7860829, 7903512, 7946428, 7989576, 8032959,
    8076577, 8120432, 8164525, 8208857, 8253431, 8298246, 8343305, 8388608,
)
# fmt: on


def log2_q22(value: int32) -> int32:
    """Compute log2 of `value` > 0, in 2^-22."""
    zeros = clz(i64(value & INT32_MAX)) - 32
    mantissa = value << (zeros - 1)
    place = (mantissa >> 23) & 127
    left = LOG2[place]
    rise = i32(i64(LOG2[place + 1] - left) * i64((mantissa >> 8) & 0x7FFF)) >> 15
    return i32(((31 - zeros) << 22) + left + rise)


def magnitude_of(e: int32) -> int32:
    """Magnitude of `e`, saturating."""
    if e >= 0:
        return e
    if e == INT32_MIN:
        return INT32_MAX
    return i32(-e)


def octaves_beyond(e: int32, delta: int32) -> int32:
    """Compute log2(\\|e\\| / `delta`) outside the linear zone, 0 in it, in 2^-22."""
    magnitude = magnitude_of(e)
    if magnitude <= delta:
        return 0
    return i32(log2_q22(magnitude) - log2_q22(delta))


def fal(e: int32, delta: int32, octaves: int32) -> int32:
    """Compute sign(`e`) `delta` 2^`octaves` outside the linear zone, `e` in it.

    `octaves` is alpha times `octaves_beyond`, in 2^-22.
    """
    magnitude = magnitude_of(e)
    if magnitude <= delta:
        return e
    place = (octaves >> 15) & 127
    left = EXP2[place]
    mantissa = left + (i32(i64(EXP2[place + 1] - left) * i64(octaves & 0x7FFF)) >> 15)
    power = (i64(delta << (octaves >> 22)) * i64(mantissa)) >> 22
    if power < magnitude:
        magnitude = i32(power)
    if e < 0:
        return i32(-magnitude)
    return magnitude


def fal_3_4(e: int32, delta: int32) -> int32:
    """Normalised fal with alpha = 3/4."""
    octaves = octaves_beyond(e, delta)
    return fal(e, delta, octaves - (octaves >> 2))
