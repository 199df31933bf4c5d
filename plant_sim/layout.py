"""Named indices of the two flat float64 arrays that the compiled plant works on."""

# state vector
(
    POSITION,  # m, 0 = retracted
    VELOCITY,  # m/s, > 0 extends
    PRESSURE_A,  # Pa absolute, piston side
    PRESSURE_B,  # Pa absolute, rod side
    MOTOR_SPEED,  # rad/s, > 0 extends
    OIL_VOLUME,  # m³ of oil in the accumulator beyond the precharged state
) = range(6)
STATE_SIZE = 6

# parameter vector, filled by PlantParameters.vector()
(
    PISTON_AREA,  # m²
    ANNULUS_AREA,  # m²
    STROKE,  # m
    DEAD_VOLUME_A,  # m³
    DEAD_VOLUME_B,  # m³
    BULK_MODULUS,  # Pa
    VISCOUS_DAMPING,  # N s/m
    ATMOSPHERE_FORCE,  # N on the rod's cross-section, pushing the rod in
    STOP_STIFFNESS,  # N/m
    STOP_DAMPING,  # s/m
    PUMP_A_FLOW,  # m³/rad, before pressure-dependent losses
    PUMP_B_FLOW,  # m³/rad
    PUMP_A_LOSS,  # m³/rad, from the high to the low pressure side
    PUMP_B_LOSS,  # m³/rad
    PUMP_LOSS_PRESSURE,  # Pa over which the loss builds up
    LEAK,  # m³/(s Pa)
    CHECK_GAIN,  # m³/(s Pa)
    CHECK_CRACK,  # Pa
    RELIEF_GAIN,  # m³/(s Pa)
    RELIEF_CRACK,  # Pa
    VAPOUR_PRESSURE,  # Pa
    GAS_VOLUME,  # m³ at precharge
    PRECHARGE,  # Pa
    POLYTROPIC,  # 1
    RETRACTED_LENGTH,  # m, x_t0
    LENGTH_SQUARES,  # m², d1² + d2²
    LENGTH_PRODUCT,  # m², d1 d2
    INERTIA,  # kg m²
    PISTON_MASS,  # kg
    GRAVITY_SIN,  # N m, coefficient of sin γ in the gravity torque
    GRAVITY_COS,  # N m, coefficient of cos γ
    MOTOR_TIME_CONSTANT,  # s
    MOTOR_MAX_SPEED,  # rad/s
    MOTOR_MAX_ACCELERATION,  # rad/s²
) = range(34)
PARAMETER_COUNT = 34
