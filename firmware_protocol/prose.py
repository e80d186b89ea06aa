"""The parts of ``README.md`` that no declaration holds: explanation, rules and history."""

from firmware_protocol.messages import DEVICE_INFO_INTERVAL_S

INTRODUCTION = """\
# Wire protocol, version 1

What a sensor module, a relay unit or a local measuring device and the gateway (the host) say to one
another, over a serial line, a socket or a CAN bus. This page is for the authors of firmware. It is
generated from the declarations in this package (`python -m firmware_protocol.document`): change those, not
this page.

- All integers are little-endian; floats are IEEE 754, 32 bits, little-endian.
- A value is the number on the wire times *one step*, in the unit beside it. Units are SI, save where
  the unit column says otherwise.
- A module samples and sends; the gateway keeps the time. Nothing but a command is acknowledged or sent
  again: a lost sample shows as a gap in `sequence`.
- "Bytes" or "text" without a number go to the end of the body.
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
A sample of accelerometer and gyroscope takes 24 bytes, three classic frames exactly; with the
magnetometer it takes 30 bytes, four classic frames or one FD frame of 32.

Send the pieces of one wire frame in order and without another of the same kind between them. Wire
frames of another kind may interrupt it. Leave automatic retransmission on. A receiver that misses a
piece gives up that wire frame, counts it once and goes on at the next `index` 0.
"""

RULES = f"""\
## Rules for firmware authors

1. **Time is the moment of sampling.** Read the timer in the data-ready interrupt, not when sending. The
   timer runs freely at a nominal 1 MHz from the module's crystal, wraps at 2³², and is never set,
   steered or stopped between resets. The gateway estimates its rate and offset.
2. **Count what is sampled, not what is sent.** `sequence` goes up by one for every packet of its kind,
   including one that had to be thrown away, and starts at 0 after a reset.
3. **One set of axes.** Accelerometer, magnetometer and gyroscope readings are turned into one
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
   a sender. Two modules of one id can share a radio until one is told another, by its unique id; on a CAN
   bus they cannot, for their identifiers would collide: set the id of a new module before it joins.
9. **Say who you are.** Send `DeviceInfo` after a reset and every {DEVICE_INFO_INTERVAL_S:g} s, `Health`
   every second.
10. **A triggered sample has the trigger's number** as its `sequence`, and its `triggered` bit set. A module
    that misses a trigger sends nothing for it, so the gap shows. A trigger that comes twice is obeyed once.
    While a module samples on triggers (setting `mode` 3) it sends no other samples of that kind.
11. **Answer `SyncRequest` at once**, or say truly how long it took: read the timer when the request's last
    byte came and again when the response goes to the line.
12. **Cut text between characters.** A log line or label that is no UTF-8, or holds a zero, is dropped.
13. **Try the golden vectors** on the target before the first capture.
"""

SIGNING = """\
### Signed links

On TCP and UDP a link can be signed, in both directions, with one key of {key_size} bytes that the
gateway and the modules of the link have. Unsigned links know nothing of it. Before each wire frame goes
a signature, stuffed and ended by a zero byte like one; the wire frame itself stays as it is. Before
stuffing a signature is

{signature}

The tag is BLAKE2s (RFC 7693) with the key and a digest of {tag_size} bytes, over mark, signer and
count, and then the wire frame *as sent*: stuffed, with its zero byte. A relay signs its batches itself.
In a datagram a wire frame lies whole, with its signature.

- **Refused**, and counted: what has no signature, a wrong one, or a count that came before. A receiver
  keeps for each signer the newest count and which of those before it have come: the host {window}, a
  module 64 of the host's. So a datagram that was overtaken still passes, once. A module takes only what
  the host (signer 0) signed, the host only what others did. A module with a key obeys nothing that is
  unsigned.
- **Counting.** Each end adds one for each wire frame that it signs, and takes over the other end's
  count where a right signature has a higher one. The host begins at its time, in steps of 16 µs since
  1970, and takes nothing older than its own start.
- **A module without a clock** begins at 0, after each restart too. Its first wire frames are refused as
  outdated; the host answers with a signature before an empty wire frame (one zero byte), whose count
  the module takes over. From then on it is heard. So it need not store what it has signed, and what
  somebody recorded of it before is worth nothing.
- **Commands across restarts.** Before it obeys a `Command`, a module stores the host's newest count,
  and after a restart takes nothing up to it. Time requests and triggers need not be stored: sent again,
  they are answered and change nothing.
- **The host's clock** may be wrong. If it was set back between two runs, what was recorded since that
  earlier time can be sent again.

In C: `mocap_signing`, `mocap_sign`, `mocap_signed_decoder_push`. The signature of the worked example,
by module {signer:#010x}, its first, with the key 00 01 02 … 1f:

```
{sent}
```
"""

VECTORS = """\
## Golden vectors

`vectors/packets.json`: for each example the header, the body, the bytes on a byte stream, the CAN frames
(classic and FD, null where the body is too long), the same as link records, and the decoded values. Hex
strings are in the order of sending. `identifier` is the 29-bit number without flags.

`vectors/defects.json`: damaged input, what is to be dropped for which reason, and what is to survive it.

`vectors/commands.json`: for each verb the arguments and the payload, as values and bytes, and command and
acknowledgement on every link.

`vectors/signing.json`: a key, tags of bytes of all lengths about a block, and signed wire frames of both
directions: what is taken of them, dropped for which reason, and the receiver's count afterwards.

`vectors/settings.json`: for each setting the factory value and another, as value and bytes, and the image
of a slot.

`python -m firmware_protocol.golden` writes them from the declarations; the tests hold the encoder and the
decoder to the committed bytes.
"""

HISTORY = """\
## Version history

| Version | What changed |
| --- | --- |
| 1 | First version: kinds 0x10, 0x11, 0x18, 0x20, 0x30, 0x31. |
| 1 | Kinds added: 0x12, 0x19 to 0x1B, 0x32, 0x33, 0x40 to 0x42, 0x50, 0x51, 0x5E, 0x5F. |
| 1 | Signatures before wire frames, on links that have a key. |

A change that an old receiver would misread takes a new version number. A new kind does not: receivers
count and skip kinds they do not know. Kind numbers are never given a second meaning.
"""

COMMANDS = """\
## Commands

The host sends a `Command`, each device that is meant sends an `Acknowledgement`. The host repeats a
command that is not answered, under the same `transaction`.

- **Who is meant.** `unique_id` all zeros: the module of the header's id, or every one if that is 255.
  Otherwise only the device of that unique id, whatever its module id; the header then says 255.
- **Duplicates.** A device remembers the last {memory} pairs of `transaction` and `verb`, with its answers.
  It answers a pair that it remembers as before, and does not act again.
- **Answers to 255** wait for {delay_ms} ms times the device's id, so that they do not collide on a shared
  radio.
- **Writes.** A device whose writes are locked refuses every verb that changes it, with result 3.
- The payload is empty unless the result is 0. Arguments of another length than declared, or out of the
  limits, are bad arguments (2).
"""

SETTINGS_RULES = """\
## Settings

`WRITE_SETTING` stages a value; `COMMIT` stores all that is staged, or none of it. A value outside the
limits is refused with result 2, a key that the device does not have with 6. Numbers on the wire and in
flash are the same bytes; limits and factory values below are in the unit of the value.
"""

FLASH = """\
## Flash

Settings lie in one of two slots of {size} bytes, each erased by itself. A slot holds

{head}

then for each setting

{entry}

and at its end

{checksum}

With every setting that is {largest} bytes. Unknown keys are skipped; a setting that is not in the slot
has its factory value.

- **Commit.** Erase the slot that is not in use. Program everything but the magic. Read it back. Program the
  magic, last. Read everything back. Only now is the command answered.
- **Start.** A slot counts when its magic and its checksum are right. Of two that count, the newer
  generation is used: `b` is newer than `a` if `(b - a) mod 2^32` is between 1 and 2^31 - 1. If none counts,
  the factory settings are used, and said so by `Event` 8.

So a loss of power at any instant leaves the old settings or the new ones, whole. Erased flash is 0xFF and
programming only clears bits: an unfinished magic is no magic.
"""

TRANSFER = """\
### Long wire frames on CAN

A wire frame whose body is too long for one set of CAN frames, such as a large relay batch, goes in pieces
(after ISO 15765-2). The whole is the wire frame as on a byte stream before stuffing, checksum included.
Each piece is a wire frame of its own: `TransferToHost` from a module or relay, `TransferToModule` from the
host; flow control goes by the kind of its own sender, under the same module id.

1. **First** (1): `number` is the size of the whole, `data` its beginning, at most {piece} bytes. The sender
   waits for flow control.
2. **Consecutive** (2): `number` is the place of the piece, from 1; all hold as many bytes as the first one,
   save the last. After a block the sender waits for flow control.
3. **Flow control** (3): `number` is the place of the piece wanted next, and `data` holds

{flow_control}

The receiver sends flow control after the first piece and after each block; when a piece is missing
("repeat", once for each gap); and when it has waited {piece_ms} ms for a piece. Told to wait, a sender
waits for more flow control, which comes every {wait_ms} ms. A sender that receives nothing for {flow_ms} ms
sends its last piece again. Either end gives up after {retries} such time-outs in a row. A receiver passes
over pieces that it has already; if it was the last piece of a block, it repeats its flow control.
"Continue" for a block that was continued already is passed over by the sender. One sender has one transfer
at a time; a new `transfer` ends the one before.
"""

DBC = """\
### DBC file

`module.dbc` describes all this to the tools of a CAN bus, for module 0. `mocap-gateway config dbc --modules
0-16 -o suit.dbc` writes the file of a suit. In it every CAN frame of a wire frame is a message of its own,
since a DBC knows nothing of reassembly:

- The identifier holds the module, so each module has its own messages, and 255 has those of what the host
  sends to all.
- On CAN FD most wire frames are one CAN frame, `..._fd`. Samples are multiplexed by the three presence
  bits of their mask.
- On classic CAN the mask is in the first piece and the readings are in others, which no multiplexer can
  follow: the file describes samples with accelerometer, magnetometer and gyroscope all present, unless
  `--sensor` names others.
- A number that is cut by the end of a piece is two signals, `..._low` and `..._high`, whose physical values
  add up to the number's; a float cut so is two signals `..._low` and `..._high` of raw bits.
- Of bodies without a fixed size, the fields before the part of any length are described, on classic CAN.
"""

VERSIONS = """\
## Versions

Each party knows the versions from a lowest to a highest one; this description is of {versions}. The
host says its own in `HELLO`, always in wire frames of version 1; the device chooses the highest that both
know, or 0, and answers with its own range, as version 1 too. From then on both send the chosen version,
until the device starts anew. Without `HELLO`, version 1 is spoken.
"""
