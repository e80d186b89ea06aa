"""The parts of ``README.md`` that no declaration holds: explanation, rules and history."""

INTRODUCTION = """\
# Wire protocol, version 1

What a sensor module, a relay unit or a local measuring device sends to the gateway, over a serial
line, a socket or a CAN bus. This page is for the authors of firmware. It is generated from the
declarations in this package (`python -m firmware_protocol.document`): change those, not this page.

- All integers are little-endian; floats are IEEE 754, 32 bits, little-endian.
- A value is the number on the wire times *one step*, in the unit beside it. Units are SI, save where
  the unit column says otherwise.
- A module samples and sends; the gateway keeps the time. Nothing is acknowledged or sent again: a
  lost sample shows as a gap in `sequence`.
"""

BYTE_STREAM = """\
### On a byte stream

The wire frame is stuffed by COBS (Cheshire and Baker, 1999), so that it holds no zero byte, and is
ended by one zero byte. Send a zero byte before the first wire frame too, and after any pause in which
the line may have picked up noise: an empty stretch between two zeros is ignored, and a broken stretch
costs nothing but itself.

The checksum is the CRC-32 of zlib, Ethernet and PNG: polynomial 0x04C11DB7, reflected, initial value
and final exclusive-or 0xFFFFFFFF. Check value: the nine ASCII digits `123456789` give 0xCBF43926.
"""

WORKED_EXAMPLE = """\
### Worked example

Module 3 at rest, its sample 17, taken at 1.25 s, the magnetometer not read: specific force
(0, 0, 9.81) m/s², angular rate (0, 0.1, 0) rad/s. The body (mask, then the numbers):

```
{body}
```

The wire frame, then as sent on a byte stream:

```
{raw}
{sent}
```

As sent on classic CAN, identifier and data of each CAN frame:

```
{pieces}
```
"""

RELAY = """\
Sent by a relay (module 254): wire frames of other modules, and its own, without version and checksum,
one entry after another to the end of the body. An entry is never a batch itself. An entry of unknown
kind is skipped; an entry that runs past the end ends the batch; good entries stand in either case.
`sequence` and `module_time_us` of the batch count and time the relay's sending; those of an entry are
the module's own and are forwarded as they are.
"""

CAN = """\
## On a CAN bus

29-bit identifiers only, classic or FD frames. Bit rates are the installation's choice; 11-bit traffic
and 29-bit traffic of another version number can share the bus.

{identifier}

The pieces of one wire frame, joined in the order of `index`, hold

{payload}

cut into pieces of 8 bytes (classic) or 64 bytes (FD). Only the last piece may be shorter. The last
piece of an FD frame is padded with zeros to the next length that CAN FD has
({lengths}); `body_length` tells where the body ends.
The checksum is that of the same wire frame on a byte stream: over version, kind, module, sequence,
module time and body, in that order, without `body_length` and padding. So a changed identifier is
noticed as well as a changed piece.

Thirty-two pieces hold a body of at most {classic} bytes on classic CAN; on FD, `body_length` allows {fd}.
A sample of accelerometer and gyrometer takes 24 bytes, three classic frames exactly; with the
magnetometer it takes 30 bytes, four classic frames or one FD frame of 32.

Send the pieces of one wire frame in order and without another of the same kind between them. Wire
frames of another kind may interrupt it. Leave automatic retransmission on. A receiver that misses a
piece gives up that wire frame, counts it once and goes on at the next `index` 0.
"""

RULES = """\
## Rules for firmware authors

1. **Time is the moment of sampling.** Read the timer in the data-ready interrupt, not when sending. The
   timer runs freely at a nominal 1 MHz from the module's crystal, wraps at 2³², and is never set,
   steered or stopped between resets. The gateway estimates its rate and offset.
2. **Count what is sampled, not what is sent.** `sequence` goes up by one for every packet of its kind,
   including one that had to be thrown away, and starts at 0 after a reset.
3. **One set of axes.** Accelerometer, magnetometer and gyrometer readings are turned into one
   right-handed set of axes, that drawn on the case. At rest the accelerometer reads about
   +9.81 m/s² on the axis that points up. A positive angular rate is right-handed about its axis.
4. **A sensor that was not read is left out**, by its mask bit; never send zeros or the last value in its
   place. A slower sensor is present only in the samples for which it has a new reading.
5. **Say when a value is clipped.** Limit to ±32767 (fine: ±2147483647) rather than wrap, and set the clipped
   bit when any axis stood at the end of the range the *sensor* was set to, even where the wire could
   hold more.
6. **Send raw readings.** Scale to the unit, but leave filtering, bias removal and calibration to the gateway,
   which can be told about them and can be corrected later.
7. **Reserved bits are 0; floats are finite; a standard deviation is not negative.** Whatever breaks this is
   dropped and counted.
8. **Module ids** are 0 to 63, unique in a suit. 254 is the relay. 255 addresses every module and is never
   a sender.
9. **Say who you are.** Send `DeviceInfo` after a reset and every ten seconds, `Health` every second.
10. **Try the golden vectors** on the target before the first capture.
"""

VECTORS = """\
## Golden vectors

`vectors/packets.json`: for each example the header, the body, the bytes on a byte stream, the CAN frames
(classic and FD, null where the body is too long), the same as link records, and the decoded values. Hex
strings are in the order of sending. `identifier` is the 29-bit number without flags.

`vectors/defects.json`: damaged input, what is to be dropped for which reason, and what is to survive it.

`python -m firmware_protocol.golden` writes both from the declarations; the tests hold the encoder and the
decoder to the committed bytes.
"""

HISTORY = """\
## Version history

| Version | What changed |
| --- | --- |
| 1 | First version. |

A change that an old receiver would misread takes a new version number. A new kind does not: receivers
count and skip kinds they do not know. Kind numbers are never given a second meaning.
"""
