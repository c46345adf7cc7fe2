//! Frames computed by hand from `docs/yourarm-protocol.md`, with a CRC that is not ours. Adapter and emulator are
//! both tested against them, so that a mistake which both sides share still shows.

/// Bytes written as hexadecimal digits.
pub fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect()
}

/// Joints of the samples [deg].
pub const JOINTS: [f64; 6] = [10.0, -20.0, 30.0, -40.0, 50.0, -60.0];
/// Pose of the samples [mm, deg].
pub const POSE: [f64; 6] = [300.0, -100.0, 250.5, 180.0, 0.0, -90.0];

/// HELLO, sequence 1.
pub const HELLO: &str = "59410101010000009b5f";
/// GET_STATE, sequence 2.
pub const GET_STATE: &str = "5941010202000000952a";
/// GET_STATE with the gripper's force, sequence 21.
pub const GET_STATE_AND_FORCE: &str = "594101021500010001b754";
/// SET_MODE servo, sequence 3.
pub const SET_MODE: &str = "594101030300010001c8d8";
/// ENABLE on, sequence 4.
pub const ENABLE: &str = "5941010404000100015d77";
/// CLEAR_ERROR, sequence 5.
pub const CLEAR_ERROR: &str = "59410105050000006c1c";
/// STOP, sequence 0xFFFE.
pub const STOP: &str = "59410106feff00008fbc";
/// MOVE_JOINTS at 25 % to [`JOINTS`], sequence 7.
pub const MOVE_JOINTS: &str = "5941011007001c000000c841000020410000a0c10000f041000020c200004842000070c25769";
/// SERVO_JOINTS to [`JOINTS`], sequence 8.
pub const SERVO_JOINTS: &str = "5941011108001800000020410000a0c10000f041000020c200004842000070c20419";
/// VELOCITY_JOINTS 1.5, 0, 0, 0, 0, −90 deg/s, sequence 9.
pub const VELOCITY_JOINTS: &str = "59410112090018000000c03f000000000000000000000000000000000000b4c2b5f7";
/// SETPOINT of [`JOINTS`] with all that one can have: valid for 40 ms, made at 123.456789 s, 1 −2 3 −4 5 −6 deg/s,
/// 0.5 −0.5 1 −1 2 −2 deg/s², 8 −7 6 −5 4 −3 Nm, 100 90 80 70 60 50 Nm/rad, 1 to 6 Nm·s/rad; sequence 23.
pub const SETPOINT: &str = "5941011417009b0007280015cd5b0700000000000020410000a0c10000f041000020c200004842000070c20000803f000000c0000\
    04040000080c00000a0400000c0c00000003f000000bf0000803f000080bf00000040000000c0000000410000e0c00000c0400000\
    a0c000008040000040c00000c8420000b4420000a04200008c4200007042000048420000803f0000004000004040000080400000a\
    0400000c0406da3";
/// SETPOINT of [`JOINTS`] at 1 −2 3 −4 5 −6 deg/s, made at 1 µs; sequence 24.
pub const SETPOINT_BARE: &str = "5941011418003b000000000100000000000000000020410000a0c10000f041000020c200004842000070c20000803f000000c0000\
    04040000080c00000a0400000c0c049bc";
/// SET_MODE impedance, sequence 25.
pub const SET_MODE_IMPEDANCE: &str = "5941010319000100037eba";
/// MOVE_CARTESIAN at 50 % to [`POSE`], sequence 10.
pub const MOVE_CARTESIAN: &str = "594101130a001c0000004842000096430000c8c200807a4300003443000000000000b4c22398";
/// GRIPPER to 42.5 mm, sequence 11.
pub const GRIPPER: &str = "594101200b00040000002a42b473";
/// GRIP to 42.5 mm with at most 12.5 N, sequence 22.
pub const GRIP: &str = "594101251600080000002a4200004841ffa2";
/// Load of the samples: 1.5 kg at 0, −10, 80 mm; inertia 0.01, 0, 0.001, 0.02, 0, 0.03 kg·m².
pub const LOAD: [f64; 10] = [1.5, 0.0, -10.0, 80.0, 0.01, 0.0, 0.001, 0.02, 0.0, 0.03];
/// SET_PAYLOAD to [`LOAD`], sequence 15.
pub const SET_PAYLOAD: &str =
    "594101210f0028000000c03f00000000000020c10000a0420ad7233c000000006f12833a0ad7a33c000000008fc2f53cc9fd";
/// GET_PAYLOAD, sequence 16.
pub const GET_PAYLOAD: &str = "5941012210000000eed4";
/// SET_MOUNTING 0, 0, 1: the base hangs from a ceiling; sequence 17.
pub const SET_MOUNTING: &str = "5941012311000c0000000000000000000000803f360b";
/// GET_MOUNTING, sequence 18.
pub const GET_MOUNTING: &str = "594101241200000003f4";
/// GET_JOINT_STATUS, sequence 19.
pub const GET_JOINT_STATUS: &str = "59410140130000006d12";
/// GET_OFFSETS, sequence 20.
pub const GET_OFFSETS: &str = "594101411400000011e9";
/// GET_IO, sequence 12.
pub const GET_IO: &str = "594101300c000000a2c0";
/// SET_DIGITAL output 3 high, sequence 13.
pub const SET_DIGITAL: &str = "594101310d000200030127d6";
/// SET_ANALOG output 1 to 2.5 V, sequence 14.
pub const SET_ANALOG: &str = "594101320e00050001000020409fb1";

/// Reply to [`HELLO`]: YOURARM-6, 6 joints, firmware 2.1.3, serial number YA6-00042.
pub const HELLO_REPLY: &str = "594101810100250000594f555241524d2d3600000000000000060201035941362d303030343200000000\
    000000b08a";
/// Reply to [`GET_STATE`]: 123.456789 s, moving, servo mode, enabled, gripper fitted, no error, [`JOINTS`],
/// 1 −2 3 −4 5 −6 deg/s, 0.5 −0.5 1 −1 2 −2 Nm, 42.5 mm, [`POSE`].
pub const STATE_REPLY: &str = "59410182020073000015cd5b0700000000020103060000000020410000a0c10000f041000020c2000048\
    42000070c20000803f000000c000004040000080c00000a0400000c0c00000003f000000bf0000803f000080bf00000040000000c000002a\
    42000096430000c8c200807a4300003443000000000000b4c20f85";
/// Reply to [`GET_STATE_AND_FORCE`]: as [`STATE_REPLY`], and 12.25 N.
pub const STATE_AND_FORCE_REPLY: &str = "59410182150077000015cd5b0700000000020103060000000020410000a0c10000f0410000\
    20c200004842000070c20000803f000000c000004040000080c00000a0400000c0c00000003f000000bf0000803f000080bf0000004000\
    0000c000002a42000096430000c8c200807a4300003443000000000000b4c200004441b136";
/// Refusal of [`GRIP`]: outside the limits; no error.
pub const GRIP_REFUSED: &str = "594101a516000300070000177a";
/// Refusal of [`SET_MODE`]: the arm is moving; no error.
pub const MOVING_REPLY: &str = "594101830300030006000058f8";
/// Refusal of [`SERVO_JOINTS`]: in error 2.
pub const IN_ERROR_REPLY: &str = "5941019108000300080200067c";
/// Reply to [`GET_JOINT_STATUS`]: 30.5 to 35.5 °C, 0 to 1.25 A in steps of 0.25 A, 48 V, 5 % (joint 3: −12.5 %), no
/// error but 7 of joint 6.
pub const JOINT_STATUS_REPLY: &str = "594101c013006d00000000f44100000000000040420000a04000000000fc410000803e000040\
    420000a0400000000002420000003f00004042000048c10000000006420000403f000040420000a040000000000a420000803f00004042\
    0000a040000000000e420000a03f000040420000a0400700831d";
/// Offsets of the samples [deg].
pub const OFFSETS: [f64; 6] = [1.5, -2.0, 0.0, 0.25, 10.0, -0.5];
/// Reply to [`GET_OFFSETS`]: [`OFFSETS`].
pub const OFFSETS_REPLY: &str = "594101c114001900000000c03f000000c0000000000000803e00002041000000bfaa97";
/// Reply to [`GET_PAYLOAD`]: [`LOAD`].
pub const PAYLOAD_REPLY: &str =
    "594101a210002900000000c03f00000000000020c10000a0420ad7233c000000006f12833a0ad7a33c000000008fc2f53c1e95";
/// Reply to [`GET_MOUNTING`]: 0, 0, −1.
pub const MOUNTING_REPLY: &str = "594101a412000d00000000000000000000000080bf266c";
/// Reply to [`GET_IO`]: all inputs but di1 high, do3 high, 1.5 V and −0.25 V at the inputs, 0 V and 2.5 V at the
/// outputs.
pub const IO_REPLY: &str = "594101b00c00150000fd0008000000c03f000080be000000000000204036f0";
/// Refusal of [`SET_DIGITAL`]: there is no such channel; no error.
pub const NO_CHANNEL_REPLY: &str = "594101b10d0003000a0000cb76";
/// Good reply to [`STOP`].
pub const STOP_REPLY: &str = "59410186feff010000470a";

#[test]
fn the_samples_of_the_sheet_are_these() {
    let sheet = include_str!("../../../../docs/yourarm-protocol.md").replace(' ', "");
    for frame in [
        HELLO,
        GET_STATE,
        SET_MODE,
        MOVING_REPLY,
        SERVO_JOINTS,
        SETPOINT,
        SETPOINT_BARE,
        SET_MODE_IMPEDANCE,
        GRIPPER,
        GET_STATE_AND_FORCE,
        GRIP,
        GRIP_REFUSED,
        GET_IO,
        SET_DIGITAL,
        SET_ANALOG,
        IO_REPLY,
        SET_PAYLOAD,
        SET_MOUNTING,
        GET_JOINT_STATUS,
        OFFSETS_REPLY,
    ] {
        assert!(sheet.contains(&format!("`{frame}`")), "{frame}");
    }
}
