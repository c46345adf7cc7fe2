//! The control path neither allocates nor frees memory. The allocator counts every allocation, reallocation and release
//! of the threads that ask for it.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use dimos::arm::{ArmCommand, ArmState, Link};
use dimos::arms::mock::SPEC;
use dimos::clock::{Clock, MonotonicClock};
use dimos::collision::World;
use dimos::control::config::{CartesianParams, CoordinatorConfig, TaskKind, TaskKinematics};
use dimos::control::coordinator::Coordinator;
use dimos::control::request::{Envelope, Goal, Request};
use dimos::control::task_spec::TaskTable;
use dimos::control::tick_loop::{self, Pulse, TickPorts};
use dimos::hardware::adapter::*;
use dimos::hardware::device::{Device, DeviceConfig};
use dimos::hardware::registry::AdapterConfig;
use dimos::joint::{ControlMode, joints_of};
use dimos::robot::kinematics::Kinematics;
use dimos::robot::{Source, load};
use dimos::rt::heartbeat::Heartbeat;
use dimos::rt::slot::slot;
use dimos::rt::wake::Wake;
use dimos::telemetry::{ArmSample, Cause, Event, Phase, Sample, TaskState, TaskView};

use crate::support::delegate::delegate;
use crate::support::guarded::{Guarded, cloud, cuboid, robot};
use crate::support::rig::*;
use dimos::rt::counting::{watch, watched_calls};

#[test]
fn the_counter_sees_allocation_growth_and_release() {
    watch(true);
    let mut list = std::hint::black_box(Vec::with_capacity(1));
    list.push(1u8);
    list.extend([0; 100]);
    drop(list);
    watch(false);
    assert_eq!(watched_calls(), 3);
}

#[test]
fn ticks_with_every_task_type_do_not_allocate() {
    let model = load(&Source::new("builtin:yourarm")).into_model().unwrap();
    let (kinematics, link) = (Kinematics::whole(&model).unwrap(), model.link_index("flange").unwrap());
    let robot = TaskKinematics::new(kinematics, link);
    let steered = |name: &str| TaskKind::new(name, &CartesianParams::default()).of_robot(robot.clone());
    let tasks = vec![
        task("traj_left", trajectory(), 0..7, 10),
        task("traj_right", trajectory(), 7..13, 10),
        task("traj_both", trajectory(), 0..13, 15),
        task("servo", servo(), 0..7, 20),
        task("velocity", velocity(), 7..13, 20),
        task("servo_too", servo(), 5..7, 20),
        task("poses", steered("cartesian_ik"), 13..19, 20),
        task("twists", steered("eef_twist"), 13..19, 25),
    ];
    let mut rig = Rig::new(100.0, vec![arm("left", 7), arm("right", 6), arm("third", 6)], tasks);
    rig.make_ready();
    rig.arms[1].reports_velocity = false;
    rig.around = watch;
    let (mut seen, mut id) = ([0u64; 8], 0);
    let pose = Goal::Pose { position: [0.3, 0.1, 0.4], orientation: [0.0, 1.0, 0.0, 0.0] };
    let nowhere = Goal::Pose { position: [0.3, f64::NAN, 0.4], orientation: [0.0, 1.0, 0.0, 0.0] };
    let twist = Goal::Twist { linear: [0.1, 0.0, 0.2], angular: [0.1, 0.0, 0.0], tool: true };
    for k in 0..20_000u64 {
        let (left, right) = (rig.arms[0].q[0].clamp(-1.9, 1.9), rig.arms[1].q[0].clamp(-1.9, 1.9));
        let to = if (k / 500).is_multiple_of(2) { 0.4 } else { -0.4 };
        if k % 97 == 0 {
            id += 1;
            rig.send(Request::Execute { task: 0, motion: sweep(id, 0..7, left, to, 0.9) });
            rig.send(Request::Execute { task: 1, motion: sweep(id, 7..13, right, to, 0.9) });
        }
        match k % 1009 {
            700 => _ = rig.send(Request::Execute { task: 2, motion: sweep(id, 0..13, left, to, 1.0) }),
            730 => _ = rig.send(Request::Cancel { task: None }),
            800..=819 => _ = rig.servo(3, &[left + 0.01; 7]),
            // Both, so that one loses.
            820..=830 => _ = (rig.servo(3, &[left + 0.01; 7]), rig.velocity(4, &[0.2 * to; 6])),
            831..=860 => _ = rig.velocity(4, &[0.2 * to; 6]),
            870..=875 => _ = rig.servo(5, &[left; 2]),
            880 => _ = rig.servo(3, &[f64::NAN; 7]),
            500..=540 => _ = rig.send(Request::CartesianTarget { task: 6, goal: pose }),
            541..=590 => _ = rig.send(Request::CartesianTarget { task: 7, goal: twist }),
            595 => _ = rig.send(Request::CartesianTarget { task: 6, goal: nowhere }),
            // Out of reach, until the arm is held.
            885 => _ = rig.servo(3, &[left + 0.01; 7]),
            886..=909 => _ = rig.servo(3, &[left + 1.2; 7]),
            910 => _ = rig.send(Request::Gripper { arm: 0, opening: 0.03, force: None, speed: None }),
            920 => _ = rig.send(Request::Stop { arm: None }),
            940 => rig.arms[1].error = 3,
            945 => rig.arms[0].silent = true,
            960 => (rig.arms[1].error, rig.arms[0].silent) = (0, false),
            970 => {
                for arm in 0..3 {
                    rig.send(Request::Reset { arm });
                    rig.send(Request::Enabled { arm, outside: false });
                }
            }
            975 => (0..200).for_each(|_| _ = rig.servo(3, &[left; 7])),
            _ => {}
        }
        rig.tick_after(u32::from(k % 4001 == 0));
        for (_, event) in &rig.events {
            match event {
                Event::Task(_, TaskState::Completed, _) => seen[0] += 1,
                Event::Task(_, TaskState::Fault, _) => seen[1] += 1,
                Event::Task(_, TaskState::Aborted, _) => seen[2] += 1,
                Event::Preempted(..) => seen[3] += 1,
                Event::ModeConflict(..) => seen[4] += 1,
                Event::Arm(_, Phase::Held, Cause::Fault(_) | Cause::Stale(_) | Cause::Jump) => seen[5] += 1,
                Event::Limited(..) => seen[6] += 1,
                Event::Task(6 | 7, TaskState::Executing, _) => seen[7] += 1,
                _ => {}
            }
        }
        rig.events.clear();
        rig.retired.clear();
    }
    assert!(seen.iter().all(|n| *n >= 10), "something hardly happened: {seen:?}");
    assert_eq!(watched_calls(), 0);
}

/// With the proof of every way to rest, whether arms are free, stopped, released, or too close from the start.
#[test]
fn guarded_ticks_do_not_allocate() {
    let mut world = World::new();
    world.add_robot(robot("fer", "arm", glamx::DAffine3::IDENTITY)).unwrap();
    world.add(cuboid("table", [2.0, 2.0, 0.1], [0.0, 0.0, -0.08])).unwrap();
    world.add(cuboid("wall", [1.0, 0.1, 1.0], [0.4, 0.5, 0.5])).unwrap();
    world.add(cloud("cloud", 500, 1.3)).unwrap();
    let home = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785];
    let mut cell = Guarded::new(world, &home, (2.0, 8.0), vec![task("servo", servo(), 0..7, 10)]);
    cell.rig.around = watch;
    let mut target = home;
    for k in 0..1200 {
        for (joint, (at, home)) in target.iter_mut().zip(home).enumerate() {
            *at = home + 1.2 * (0.02 * f64::from(k) * (1.0 + 0.1 * joint as f64)).sin();
        }
        cell.rig.servo(0, &target);
        cell.rig.tick();
        cell.rig.retired.clear();
    }
    let stops = cell.rig.count(|event| matches!(event, Event::Guard(..)));
    assert!(stops > 4 && cell.rig.phase(0) == Phase::Ready, "{stops}");
    assert_eq!(watched_calls(), 0);
}

/// The thread that ticks: rings, slots, wakes and the histogram, beside the coordinator.
#[test]
fn the_tick_loop_does_not_allocate() {
    const TICKS: u64 = 1_000;
    let tasks = vec![task("t", trajectory(), 0..6, 10), task("v", velocity(), 0..6, 20)];
    let config = CoordinatorConfig {
        version: dimos::control::config::CONFIG_VERSION,
        rate: 1000.0,
        arms: vec![arm("arm", 6)],
        tasks,
    };
    let (mut states, state_reader) = slot(ArmState::default());
    let (command_writer, mut commands) = slot(ArmCommand::default());
    let (mut requests, request_consumer) = rtrb::RingBuffer::new(256);
    let (replies, mut reply_consumer) = rtrb::RingBuffer::new(512);
    let (retired, mut retired_consumer) = rtrb::RingBuffer::new(300);
    // Small enough to be full now and then: a full ring must cost nothing either.
    let (samples, mut sample_consumer) = rtrb::RingBuffer::<Sample>::new(64);
    let empty = ArmSample {
        arm: 0,
        state: ArmState::default(),
        command: ArmCommand::default(),
        phase: Phase::Unknown,
        cause: Cause::None,
    };
    let (arm_view, mut arm_reader) = slot(empty);
    let (task_views, _task_readers): (Vec<_>, Vec<_>) = config.tasks.iter().map(|_| slot(TaskView::default())).unzip();
    let pulse = Arc::new(Pulse::default());
    let ports = TickPorts {
        states: vec![state_reader],
        commands: vec![command_writer],
        wakes: vec![Wake::new().unwrap()],
        dues: vec![Arc::default()],
        requests: request_consumer,
        replies,
        reply_wake: Wake::new().unwrap(),
        retired,
        samples,
        arm_views: vec![arm_view],
        task_views,
        guard: None,
        source: dimos::control::pace::Source::Host,
        pulse: pulse.clone(),
    };
    let counted = Arc::new(AtomicU64::new(u64::MAX));
    let probe = {
        let (counted, pulse) = (counted.clone(), pulse.clone());
        move |tick: u64| match tick {
            10 => watch(true),
            n if n == 10 + TICKS => {
                watch(false);
                counted.store(watched_calls(), Ordering::Release);
                pulse.stop.store(true, Ordering::Release);
            }
            _ => {}
        }
    };
    let (coordinator, period) =
        (Coordinator::new(&config, TaskTable::builtin().build(&config.tasks).unwrap()), config.period());
    let ticking =
        std::thread::spawn(move || tick_loop::run(coordinator, ports, period, &MonotonicClock, Some(Box::new(probe))));
    let began = Instant::now();
    let (mut state, mut id, mut completed, mut round) = (ArmState { dof: 6, ..ArmState::default() }, 0, 0, 0u64);
    while !ticking.is_finished() {
        assert!(began.elapsed() < Duration::from_secs(60));
        let command = commands.read();
        if let Some(mode) = command.mode {
            (state.mode, state.written) = (mode, command.seq);
            if mode.is_position() {
                state.position = command.values;
            }
        }
        (state.seq, state.stamp, state.enabled, state.link) = (state.seq + 1, MonotonicClock.now(), true, Link::Up);
        state.velocity_source = dimos::arm::VelocitySource::Measured;
        states.write(&state);
        let mut ask = |request| {
            id += 1;
            let _ = requests.push(Envelope { id, origin: None, request });
        };
        match arm_reader.read().phase {
            Phase::Ready if round % 40 == 0 => {
                ask(Request::Execute { task: 0, motion: sweep(1, 0..6, state.position[0], 0.02, 0.05) });
            }
            Phase::Ready if round % 40 == 30 => ask(Request::Velocity { task: 1, target: joints_of(&[0.1]) }),
            Phase::Ready => {}
            Phase::Held => ask(Request::Reset { arm: 0 }),
            _ => ask(Request::Enabled { arm: 0, outside: false }),
        }
        round += 1;
        while reply_consumer.pop().is_ok() {}
        while retired_consumer.pop().is_ok() {
            completed += 1;
        }
        if round % 8 == 0 {
            while sample_consumer.pop().is_ok() {}
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    ticking.join().unwrap();
    assert!(completed > 0, "no motion came back");
    assert!(pulse.ticks.load(Ordering::Acquire) > TICKS);
    assert_eq!(counted.load(Ordering::Acquire), 0);
}

/// The mock arm, counting between two of its readings.
struct Watched {
    inner: Box<dyn ManipulatorAdapter>,
    readings: u64,
    counted: Arc<AtomicU64>,
}

const READINGS: u64 = 300;

impl ManipulatorAdapter for Watched {
    delegate!(
        inner: connect, disconnect, is_connected, get_info, get_dof, get_limits, set_control_mode, get_control_mode,
        read_joint_positions, read_state, read_error, read_enabled, gripper, force_torque, cartesian,
        write_joint_positions, write_joint_velocities, write_stop, write_enable, write_clear_errors
    );

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.readings += 1;
        match self.readings {
            50 => watch(true),
            n if n == 50 + READINGS => {
                watch(false);
                self.counted.store(watched_calls(), Ordering::Release);
            }
            _ => {}
        }
        self.inner.read_joints(reading)
    }
}

#[test]
fn a_healthy_device_thread_does_not_allocate() {
    let config = AdapterConfig {
        hardware_id: "arm".into(),
        address: String::new(),
        dof: 6,
        options: serde_json::json!({"gripper": true, "force_torque": true}),
    };
    let counted = Arc::new(AtomicU64::new(u64::MAX));
    let adapter = Watched { inner: (SPEC.create)(&config).unwrap(), readings: 0, counted: counted.clone() };
    let beat = Arc::new(Heartbeat::default());
    let (state_writer, mut states) = slot(ArmState::default());
    let (mut commands, command_reader) = slot(ArmCommand::default());
    let device = DeviceConfig {
        hardware_id: "arm".into(),
        dof: 6,
        usb: Box::new(|| None),
        tick_period: Duration::from_millis(2),
        native_rate: 500.0,
        supervision: dimos::arm::Supervision::default(),
        setup: dimos::hardware::device::Setup::default(),
        peripherals: Default::default(),
        beat: beat.clone(),
        pace: None,
        clock: Arc::new(MonotonicClock),
        notes: Box::new(|_| {}),
    };
    let device = Device::spawn(device, Box::new(adapter), state_writer, command_reader).unwrap();
    let limit = Duration::from_secs(20);
    device.connect().wait(limit).unwrap();
    device.activate().wait(limit).unwrap();
    let (began, mut command) = (Instant::now(), ArmCommand::default());
    while counted.load(Ordering::Acquire) == u64::MAX {
        assert!(began.elapsed() < Duration::from_secs(60));
        let state = states.read();
        command.seq += 1;
        command.mode = Some(if command.seq % 100 < 50 { ControlMode::ServoPosition } else { ControlMode::Velocity });
        command.values = if command.mode == Some(ControlMode::Velocity) { joints_of(&[]) } else { state.position };
        command.gripper_seq = (command.seq / 40) as u32;
        command.stop_seq = (command.seq / 70) as u32;
        beat.beat(MonotonicClock.now());
        commands.write(&command);
        device.wake().raise();
        std::thread::sleep(Duration::from_millis(2));
    }
    device.finish(false).wait(limit).unwrap();
    device.join();
    assert_eq!(counted.load(Ordering::Acquire), 0);
}
