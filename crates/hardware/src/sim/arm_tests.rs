use super::*;
use crate::sim::faults::Fault;

const START: Mono = Mono(1_000_000_000);

fn arm_with(options: &SimOptions) -> SimArm {
    let limits = JointLimits { acceleration_max: vec![10.0; 3], ..JointLimits::uniform(3, 2.0, 1.0) };
    let options = options.clone().starting_at(&[0.5, -0.5, 1.0]);
    SimArm::new("acme", &limits, &options, PLAYABLE, START).unwrap()
}

fn arm() -> SimArm {
    arm_with(&SimOptions::default())
}

fn at(seconds: f64) -> Mono {
    START.after(Duration::from_secs_f64(seconds))
}

fn positions(arm: &SimArm) -> [f64; 3] {
    arm.joints().0.first_chunk().copied().unwrap()
}

#[test]
fn a_joint_without_its_motor_falls_while_the_others_hold() {
    let mut arm = arm();
    arm.falls(0.3, &[None, Some(-1.0), Some(0.0)]);
    arm.enable_joint(0, true);
    arm.enable_joint(2, true);
    assert!(arm.motor(0) && !arm.motor(1) && arm.motor(2) && !arm.enabled());
    assert_eq!(arm.move_to(&[0.6, 0.0, 1.0], 1.0), Err(Refusal::Disabled));
    arm.advance(at(1.0));
    let [first, second, third] = positions(&arm);
    assert!((second + 0.8).abs() < 1e-3 && (first, third) == (0.5, 1.0), "{:?}", positions(&arm));
    arm.advance(at(5.0));
    assert_eq!(positions(&arm), [0.5, -1.0, 1.0], "at its rest position");
    arm.enable(true).unwrap();
    arm.move_to(&[0.5, -0.9, 1.0], 1.0).unwrap();
    arm.advance(at(6.0));
    assert_eq!((arm.enabled(), positions(&arm)), (true, [0.5, -0.9, 1.0]));
}

#[test]
fn switching_one_motor_off_in_motion_stops_the_others() {
    let mut arm = arm();
    arm.enable(true).unwrap();
    arm.move_to(&[1.5, 0.5, 1.0], 1.0).unwrap();
    arm.advance(at(0.3));
    arm.enable_joint(1, false);
    arm.advance(at(2.0));
    let [first, second, _] = positions(&arm);
    assert!(first < 1.0 && second < 0.0 && !arm.moving(), "{:?}", positions(&arm));
}

#[test]
fn a_servo_takes_goals_at_any_time_and_follows_a_stream() {
    let mut arm = arm().without_modes();
    arm.take_goal(&[0.9, -0.5, 1.0], 0.5, false);
    arm.advance(at(1.0));
    assert_eq!(positions(&arm)[0], 0.5, "the motors are off");
    arm.enable(true).unwrap();
    arm.advance(at(2.0));
    assert_eq!(positions(&arm)[0], 0.5);
    arm.resume_goal();
    arm.advance(at(4.0));
    assert_eq!(positions(&arm)[0], 0.9, "the goal from before");
    // A stream is followed at its own speed; its last goal is not approached at top speed.
    for i in 1..=50 {
        arm.advance(at(4.0 + 0.01 * f64::from(i)));
        arm.take_goal(&[0.9 - 0.002 * f64::from(i), -0.5, 1.0], 1.0, false);
    }
    let speed = arm.joints().1[0];
    assert!((-0.35..-0.1).contains(&speed), "0.2 rad/s streamed, not the top speed of 1 rad/s: {speed}");
    assert_eq!(arm.velocity(&[0.1, 0.0, 0.0]), Ok(()), "there are no modes");
    assert_eq!(self::arm().velocity(&[0.1; 3]), Err(Refusal::Disabled));
}

#[test]
fn joints_droop_and_sink_when_commanded_to_their_measured_positions() {
    let mut arm = arm_with(&SimOptions { droop: 0.01, ..SimOptions::default() });
    arm.enable(true).unwrap();
    arm.advance(at(1.0));
    assert_eq!(positions(&arm)[0], 0.5, "it holds");
    arm.move_to(&[0.8, -0.5, 1.0], 1.0).unwrap();
    arm.advance(at(3.0));
    assert_eq!(positions(&arm), [0.8 - 0.01, -0.5 - 0.01, 1.0 - 0.01]);
    arm.move_to(&positions(&arm), 1.0).unwrap();
    arm.advance(at(4.0));
    assert!((positions(&arm)[0] - (0.8 - 0.02)).abs() < 1e-12);
    let much = SimOptions { droop: 0.3, ..SimOptions::default() };
    let error = much.check("acme", &JointLimits::uniform(3, 2.0, 1.0), PLAYABLE).unwrap_err();
    assert_eq!((error.option.as_str(), error.what.as_str()), ("sim.droop", "droop must be 0 to 0.2 rad, not 0.3 rad"));
}

#[test]
fn a_velocity_ends_exactly_when_its_time_is_over() {
    let mut arms = [arm(), arm()];
    for arm in &mut arms {
        arm.set_mode(ControlMode::Velocity).unwrap();
        arm.enable(true).unwrap();
        arm.velocity_for(&[0.5, 0.0, 0.0], Some(Duration::from_millis(200))).unwrap();
    }
    arms[0].advance(at(3.0));
    (1..=3000).for_each(|ms| arms[1].advance(at(f64::from(ms) * 1e-3)));
    let ends = arms.map(|arm| positions(&arm)[0]);
    assert!((ends[0] - ends[1]).abs() < 1e-3 && (0.55..0.65).contains(&ends[0]), "{ends:?}");
}

#[test]
fn a_scripted_estop_disables_the_motors_and_closes_after_its_duration() {
    let mut arm = arm();
    arm.enable(true).unwrap();
    arm.client_came();
    arm.inject(Fault::new(FaultKind::Estop).at(0.5).lasting(1.0), START).unwrap();
    arm.advance(at(0.6));
    assert_eq!((arm.error(), arm.enabled(), arm.estop_open()), (ESTOP, false, true));
    assert_eq!((arm.clear_error(), arm.enable(true)), (Err(Refusal::InError), Err(Refusal::InError)));
    arm.advance(at(1.6));
    assert_eq!((arm.error(), arm.estop_open()), (ESTOP, false));
    assert_eq!((arm.clear_error(), arm.enable(true)), (Ok(()), Ok(())));
}

#[test]
fn a_loss_of_power_resets_the_arm() {
    let mut arm = arm();
    arm.client_came();
    arm.enable(true).unwrap();
    arm.set_mode(ControlMode::Velocity).unwrap();
    arm.advance(at(1.0));
    assert_eq!(arm.delivery(), Delivery::Send);
    arm.inject(Fault::new(FaultKind::PowerLoss).lasting(0.5), at(1.0)).unwrap();
    assert_eq!(arm.delivery(), Delivery::PowerLoss(Duration::from_millis(500)));
    assert_eq!((arm.enabled(), arm.mode(), arm.error()), (false, ControlMode::Position, 0));
    arm.advance(at(2.0));
    assert_eq!(arm.uptime(), Duration::from_millis(500));
}
