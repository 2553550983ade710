"""The joint driver for drives on a CAN bus: CiA 402, and ODrive's CANSimple as a second protocol."""
