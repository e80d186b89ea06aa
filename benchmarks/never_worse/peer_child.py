"""Other people's filters, in an interpreter that has them: arrays in, orientations out. Imports nothing of
the gateway.

``python peer_child.py versions`` prints what is installed, as JSON. ``python peer_child.py IN OUT`` solves
one case.
"""

import json
import sys
import warnings
from importlib import metadata

import numpy as np

PACKAGES = ("imufusion", "ahrs", "qmt", "imt-ring")
GRAVITY = 9.81


def versions():
    """Version of every package that is installed and can be imported."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
            if name != "imt-ring":  # takes long, and is not run
                __import__(name)
        except Exception:  # whatever keeps it from being used
            found.pop(name, None)
    return found


def imufusion_results(gyr, acc, mag, dt):
    """With the settings that its documentation recommends."""
    import imufusion

    rate = 1.0 / dt
    settings = imufusion.AhrsSettings(
        sample_rate=rate,
        convention=imufusion.CONVENTION_NWU,
        gain=0.5,
        gyroscope_range=2000.0,
        acceleration_rejection=10.0,
        magnetic_rejection=10.0,
        rejection_timeout=5.0,
    )
    ahrs = imufusion.Ahrs().set_settings(settings)
    bias = imufusion.Bias().set_settings(imufusion.BiasSettings(sample_rate=rate))
    q = np.empty((len(gyr), 4))
    for k in range(len(gyr)):
        w = bias.update(np.degrees(gyr[k]))
        if mag is None:
            ahrs.update_no_magnetometer(w, acc[k] / GRAVITY)
        else:
            ahrs.update(w, acc[k] / GRAVITY, mag[k])
        q[k] = ahrs.get_quaternion()
    return {"imufusion": q}


def ahrs_results(gyr, acc, mag, dt, dip_deg):
    """Madgwick, Mahony and EKF, 9-axis where there is a field."""
    from ahrs.filters import EKF, Madgwick, Mahony

    frequency = 1.0 / dt
    has = {} if mag is None else {"mag": mag}
    found = {
        "Madgwick": Madgwick(gyr=gyr, acc=acc, frequency=frequency, **has).Q,
        "Mahony": Mahony(gyr=gyr, acc=acc, frequency=frequency, **has).Q,
    }
    if mag is not None:  # without a field it has no heading at all
        # its model of a level accelerometer is +z in the frame that it calls NED: north-west-up, where the
        # field dips
        # the other way
        found["EKF"] = EKF(
            gyr=gyr, acc=acc, mag=mag, frequency=frequency, frame="NED", magnetic_ref=-dip_deg
        ).Q
    return found


def qmt_results(gyr, q6, hinges, dt):
    """Headings of segments beyond hinges, by the constraint of one axis; the others stay as they were."""
    import qmt

    q, t = q6.copy(), np.arange(len(gyr)) * dt
    for parent, child, axis in hinges:
        found = qmt.headingCorrection(
            gyr[:, parent],
            gyr[:, child],
            q[:, parent],
            q[:, child],
            t,
            np.array(axis),
            {},
        )
        q[:, child] = found[0]
    return {"qmt": q}


def main():
    """One case."""
    if sys.argv[1] == "versions":
        print(json.dumps(versions()))
        return
    warnings.simplefilter("ignore")
    with np.load(sys.argv[1]) as case:
        gyr, acc, mag = (np.ascontiguousarray(case[name]) for name in ("gyr", "acc", "mag"))
        dt, dip, hinges = float(case["dt"]), float(case["dip_deg"]), case["hinges"]
        q6 = case["q6"]
    has_field = bool(np.isfinite(mag).all())
    there, found, failed = versions(), {}, {}
    n = gyr.shape[1]
    groups = {
        "imufusion": lambda g, a, m: imufusion_results(g, a, m, dt),
        "ahrs": lambda g, a, m: ahrs_results(g, a, m, dt, dip),
    }
    for package, solve in groups.items():
        if package not in there:
            continue
        try:
            columns = [
                solve(
                    *(np.ascontiguousarray(v[:, s]) for v in (gyr, acc)),
                    np.ascontiguousarray(mag[:, s]) if has_field else None,
                )
                for s in range(n)
            ]
            for name in columns[0]:
                found[name] = np.stack([column[name] for column in columns], axis=1)
        except Exception as error:  # told by name
            failed[package] = repr(error)
    if "qmt" in there and len(hinges):
        try:
            listed = [(int(p), int(c), axis) for p, c, *axis in hinges.tolist()]
            found |= qmt_results(gyr, q6, listed, dt)
        except Exception as error:  # told by name
            failed["qmt"] = repr(error)
    np.savez(sys.argv[2], failed=json.dumps(failed), **found)


if __name__ == "__main__":
    main()
