"""Cylinder chambers, pumps, valves and accumulator, eqs 1-6 in their consistent form."""

import numpy as np
from numba.extending import register_jitable

from plant_sim import layout as at


@register_jitable
def chamber_volumes(position, p):  # type: ignore[no-untyped-def]
    """Volumes in m³ of chamber A (eq. 5) and chamber B, which shrinks as the rod extends (eq. 6, mended)."""
    travel = min(max(position, 0.0), p[at.STROKE])
    volume_a = p[at.DEAD_VOLUME_A] + p[at.PISTON_AREA] * travel
    volume_b = p[at.DEAD_VOLUME_B] + p[at.ANNULUS_AREA] * (p[at.STROKE] - travel)
    return volume_a, volume_b


@register_jitable
def accumulator_pressure(oil_volume, p):  # type: ignore[no-untyped-def]
    """Absolute pressure in Pa of the low-pressure line, p0 (Vg0 / (Vg0 - V_oil))^n."""
    gas_volume = p[at.GAS_VOLUME]
    return p[at.PRECHARGE] * (gas_volume / (gas_volume - oil_volume)) ** p[at.POLYTROPIC]


@register_jitable
def chamber_inflow(pressure, pump_flow, pump_loss, line_pressure, p):  # type: ignore[no-untyped-def]
    """Oil that enters one chamber from pump, leak, check valve and relief valve: a polygon over pressure.

    Parameters
    ----------
    pressure, line_pressure : float
        Absolute pressure of the chamber and of the accumulator line, Pa.
    pump_flow : float
        Displaced flow into the chamber, m³/s (eqs 1, 2 before losses).
    pump_loss : float
        Largest loss flow |ω| (1 - η) D in m³/s; it runs from the high to the low pressure.

    Returns
    -------
    offset, slope : float
        Inflow in m³/s = offset + slope · (pressure - line_pressure) on this piece; slope ≤ 0.
    low, high : float
        Ends of the piece, as pressure - line_pressure in Pa.
    """
    excess = pressure - line_pressure
    offset = pump_flow
    slope = -p[at.LEAK]
    low = -np.inf
    high = np.inf
    loss_pressure = p[at.PUMP_LOSS_PRESSURE]
    if excess > loss_pressure:
        offset -= pump_loss
        low = loss_pressure
    elif excess < -loss_pressure:
        offset += pump_loss
        high = -loss_pressure
    else:
        slope -= pump_loss / loss_pressure
        low = -loss_pressure
        high = loss_pressure
    suction = -p[at.CHECK_CRACK]
    if excess < suction:
        offset += p[at.CHECK_GAIN] * suction
        slope -= p[at.CHECK_GAIN]
        high = min(high, suction)
    else:
        low = max(low, suction)
    relief = p[at.RELIEF_CRACK]
    if excess > relief:
        offset += p[at.RELIEF_GAIN] * relief
        slope -= p[at.RELIEF_GAIN]
        low = max(low, relief)
    else:
        high = min(high, relief)
    return offset, slope, low, high


@register_jitable
def pump_flows(speed, p):  # type: ignore[no-untyped-def]
    """Displaced flow into each chamber and largest loss flow of each pump at motor speed `speed` (rad/s).

    Returns
    -------
    flow_a, loss_a, flow_b, loss_b : float
        m³/s.
    """
    magnitude = np.abs(speed)
    return (
        speed * p[at.PUMP_A_FLOW],
        magnitude * p[at.PUMP_A_LOSS],
        -speed * p[at.PUMP_B_FLOW],
        magnitude * p[at.PUMP_B_LOSS],
    )
