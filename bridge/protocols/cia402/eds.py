"""The electronic data sheet (CiA 306) of the drive, made from its object dictionary.  The file drive.eds holds this text."""

from echelon.bridge.protocols.cia402.objects import INDICES, NAMES, OBJECTS, Object


def eds() -> str:
    """Returns the electronic data sheet as text."""
    groups = {"Mandatory": (0x1000, 0x1001, 0x1018), "Manufacturer": range(0x2000, 0x6000)}
    listed: dict[str, list[int]] = {"Mandatory": [], "Optional": [], "Manufacturer": []}
    for index in sorted(INDICES):
        listed[next((name for name, group in groups.items() if index in group), "Optional")].append(index)
    lines = _HEADER.splitlines()
    for group, indices in listed.items():
        lines += ["", f"[{group}Objects]", f"SupportedObjects={len(indices)}"]
        lines += [f"{number}=0x{index:04X}" for number, index in enumerate(indices, 1)]
        for index in indices:
            lines += _object_lines(index)
    return "\n".join(lines) + "\n"


_ARRAYS = (0x1003, 0x1016, 0x1029)
_HEADER = """\
[FileInfo]
FileName=drive.eds
FileVersion=1
FileRevision=0
EDSVersion=4.0
Description=virtual drive with cyclic synchronous torque

[DeviceInfo]
VendorName=echelon
VendorNumber=0
ProductName=echelon virtual drive
ProductNumber=1
RevisionNumber=1
BaudRate_10=0
BaudRate_20=0
BaudRate_50=0
BaudRate_125=1
BaudRate_250=1
BaudRate_500=1
BaudRate_800=0
BaudRate_1000=1
SimpleBootUpMaster=0
SimpleBootUpSlave=1
Granularity=8
DynamicChannelsSupported=0
GroupMessaging=0
NrOfRXPDO=4
NrOfTXPDO=4
LSS_Supported=0

[DummyUsage]
Dummy0001=0
Dummy0002=0
Dummy0003=0
Dummy0004=0
Dummy0005=0
Dummy0006=0
Dummy0007=0

[Comments]
Lines=0"""


def _object_lines(index: int) -> list[str]:
    entries = [entry for key, entry in OBJECTS.items() if key[0] == index]
    if index not in NAMES:
        return ["", f"[{index:04X}]", *_entry_lines(entries[0])]
    kind = 8 if index in _ARRAYS else 9
    lines = ["", f"[{index:04X}]", f"ParameterName={NAMES[index]}", f"ObjectType=0x{kind}", f"SubNumber={len(entries)}"]
    for entry in entries:
        lines += ["", f"[{index:04X}sub{entry.sub:X}]", *_entry_lines(entry)]
    return lines


def _entry_lines(entry: Object) -> list[str]:
    lines = [
        f"ParameterName={entry.name}",
        "ObjectType=0x7",
        f"DataType=0x{entry.type.number:04X}",
        f"AccessType={entry.access}",
    ]
    if isinstance(entry.default, int):
        lines.append(f"DefaultValue={'$NODEID+' if entry.node_added else ''}0x{entry.default:X}")
    elif entry.default is not None:
        lines.append(f"DefaultValue={entry.default}")
    lines.append(f"PDOMapping={int(entry.mapped)}")
    lines += [
        f"{what}={value}" for what, value in (("LowLimit", entry.low), ("HighLimit", entry.high)) if value is not None
    ]
    return lines
