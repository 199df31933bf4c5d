"""Named indices of the flat int32 arrays `calibration`, `state` and `io`, with their LSBs.

T is the control period, 1 ms. States are scaled by powers of T so that T never multiplies.
A gain takes two words: mantissa at the index, shift at the next one; it stands for mantissa / 2**shift in
the LSBs of its output over those of its input. So does a linear zone: its half width, and the log2 of that
in 2^-22.
"""

LAYOUT_VERSION = 3

# control laws
LAW_P = 1
LAW_PI = 2
LAW_ADRC = 3  # as the paper has it
LAW_PI_FF = 4  # PI with velocity feed-forward
LAW_SCHEDULED = 5  # ADRC with its model scheduled on the position

# io
IO_LAW = 0  # in: one of LAW_*; any other value commands standstill
IO_SETPOINT = 1  # in: 0.1 um
IO_POSITION = 2  # in: 1 um
IO_TARGET_VELOCITY = 3  # out: 0.25 rpm
IO_FLAGS = 4  # out: FLAG_* of this tick
IO_SATURATIONS = 5  # out: states that hit their 32-bit range since the last reset
IO_SIZE = 6

FLAG_SPEED_LIMITED = 1  # the law asked for more than the drive's speed
FLAG_SETPOINT_LIMITED = 2  # the limiter's output differs from the setpoint
FLAG_STATE_SATURATED = 4  # a state hit its 32-bit range in this tick

# state
ST_LAW = 0  # law of the last tick
ST_SATURATIONS = 1  # see IO_SATURATIONS
ST_LIMITER_INPUT = 2  # last setpoint, 2^-31 m
ST_LIMITER_POSITION = 3  # limited setpoint, 2^-31 m
ST_LIMITER_RATE = 4  # its last increment, 2^-31 m per T
ST_V1 = 5  # tracking differentiator or front end: position, 2^-31 m
ST_V2 = 6  # v2 T, 2^-38 m
ST_V3 = 7  # v3 T^2, 2^-40 m
ST_Z1 = 8  # observer: position, 2^-31 m
ST_Z2 = 9  # z2 T, 2^-38 m
ST_Z3 = 10  # z3 T^2, 2^-40 m
ST_Z4 = 11  # z4 T^3, 2^-42 m
ST_INTEGRAL = 12  # PI: integral part of the command, 2^-20 rad/s
ST_U = 13  # command sent (clipped, quantised), 2^-20 rad/s
ST_V2_SMOOTH = 14  # front end: v2 T behind its low-pass, 2^-38 m
ST_MOTOR = 15  # scheduled: speed of the motor in its model, 2^-20 rad/s
ST_DISTURBANCE = 16  # scheduled: total disturbance as a speed, 2^-20 rad/s
ST_COMMAND = 17  # command filter's output, 2^-20 rad/s
ST_SIZE = 18

# calibration
CAL_U_LIMIT = 0  # drive's speed, 2^-20 rad/s
CAL_LIMITER_RATE = 1  # largest increment of the limited setpoint, 2^-31 m per T
CAL_LIMITER_SLEW = 2  # largest change of that increment, 2^-31 m per T^2
CAL_LIMITER_BRAKE = 3  # change of it the approach is planned with, 2^-31 m per T^2
CAL_P_KP = 4  # gain: 2^-31 m -> 2^-20 rad/s
CAL_PI_KP = 6  # gain: 2^-31 m -> 2^-20 rad/s
CAL_PI_KI = 8  # gain, Ki T: 2^-31 m -> 2^-20 rad/s
CAL_TD_D = 10  # r0 h0^2, 2^-34 m
CAL_TD_K = 11  # gain, (T / h0)^2: 2^-34 m -> 2^-40 m
CAL_TD_H = 13  # gain, h0 / T: 2^-38 m -> 2^-34 m
CAL_LEAD_V1 = 15  # gain, 2 h0 / T: 2^-38 m -> 2^-31 m
CAL_LEAD_V2 = 17  # gain, 2 h0 / T: 2^-40 m -> 2^-38 m
CAL_ESO_DELTA = 19  # zone of the observer's fal, 2^-31 m
CAL_ESO_BETA1 = 21  # gain, beta01 T: 2^-31 m -> 2^-31 m
CAL_ESO_BETA2 = 23  # gain, beta02 T^2: 2^-31 m -> 2^-38 m
CAL_ESO_BETA3 = 25  # gain, beta03 T^3: 2^-31 m -> 2^-40 m
CAL_ESO_BETA4 = 27  # gain, beta04 T^4: 2^-31 m -> 2^-42 m
CAL_ESO_A1 = 29  # gain, a1n T^2: 2^-38 m -> 2^-40 m
CAL_ESO_A2 = 31  # gain, a2n T: 2^-40 m -> 2^-40 m
CAL_ESO_B0 = 33  # gain, b0 T^3: 2^-20 rad/s -> 2^-40 m
CAL_FB_DELTA1 = 35  # zones of the feedback's fal: 2^-31 m
CAL_FB_DELTA2 = 37  # 2^-38 m
CAL_FB_DELTA3 = 39  # 2^-40 m
CAL_FB_K1 = 41  # gain, wc^3 / b0: 2^-31 m -> 2^-20 rad/s
CAL_FB_K2 = 43  # gain, 3 wc^2 / (b0 T): 2^-38 m -> 2^-20 rad/s
CAL_FB_K3 = 45  # gain, 3 wc / (b0 T^2): 2^-40 m -> 2^-20 rad/s
CAL_FB_A1 = 47  # gain, a1n / (b0 T): 2^-38 m -> 2^-20 rad/s
CAL_FB_A2 = 49  # gain, a2n / (b0 T^2): 2^-40 m -> 2^-20 rad/s
CAL_FB_Z4 = 51  # gain, 1 / (b0 T^3): 2^-42 m -> 2^-20 rad/s
CAL_FRONT_SMOOTH = 53  # gain, share of a period in v3's time constant: 2^-38 m -> 2^-40 m
CAL_FRONT_LEAD = 55  # gain, lead time / T: 2^-40 m -> 2^-38 m
CAL_FRONT_EXTEND = 57  # gain, speed per rod speed: 2^-38 m -> 2^-20 rad/s
CAL_FRONT_RETRACT = 59  # gain, speed per rod speed: 2^-38 m -> 2^-20 rad/s
CAL_COMMAND_SMOOTH = 61  # gain, share of a period in the filter's time constant: 2^-20 -> 2^-20 rad/s
CAL_COMMAND_SLEW = 63  # largest change of the command, 2^-20 rad/s per T
CAL_STROKE = 64  # L, 2^-31 m
CAL_STIFFNESS_END_A = 65  # length of the dead volume behind the piston, 2^-31 m
CAL_STIFFNESS_END_B = 66  # length of the dead volume on the rod's side, 2^-31 m
CAL_STIFFNESS_A = 67  # column A's share of the stiffness times its length, 2^-31 m
CAL_STIFFNESS_B = 68  # column B's share of the stiffness times its length, 2^-31 m
CAL_SCHEDULED_BETA1 = 69  # gain, beta01 T: 2^-31 m -> 2^-31 m
CAL_SCHEDULED_BETA2 = 71  # gain, beta02 T^2: 2^-31 m -> 2^-38 m
CAL_SCHEDULED_BETA3 = 73  # gain, beta03 T^3: 2^-31 m -> 2^-40 m
CAL_SCHEDULED_BETA4 = 75  # gain, part of beta04 T / b0 in proportion to a1n: 2^-31 m -> 2^-20 rad/s
CAL_SCHEDULED_BETA4_SOFT = 77  # gain, the other part at stiffness 1: 2^-31 m -> 2^-20 rad/s
CAL_SCHEDULED_B0 = 79  # gain, b0 T^3 at stiffness 1: 2^-20 rad/s -> 2^-40 m
CAL_SCHEDULED_MOTOR = 81  # gain, share of a period in the motor's time constant: 2^-20 -> 2^-20 rad/s
CAL_SCHEDULED_K1 = 83  # gain: 2^-31 m -> 2^-20 rad/s
CAL_SCHEDULED_K2 = 85  # gain: 2^-38 m -> 2^-20 rad/s
CAL_SCHEDULED_K3 = 87  # gain, constant part: 2^-40 m -> 2^-20 rad/s
CAL_SCHEDULED_K3_SOFT = 89  # gain, part in proportion to 1 / stiffness: 2^-40 m -> 2^-20 rad/s
CAL_SIZE = 91
