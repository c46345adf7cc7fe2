use super::*;

fn plant(tracking: Tracking) -> Plant {
    let limits = JointLimits { acceleration_max: vec![10.0; 2], ..JointLimits::uniform(2, 2.0, 1.0) };
    let mut plant = Plant::new(&limits, &[0.5, -0.5], tracking, 0.0);
    plant.enable(true);
    plant
}

/// Advances in steps of 1 ms and checks velocity, acceleration and position limits at every one.
fn run(plant: &mut Plant, seconds: f64, mut each: impl FnMut(&Plant)) {
    for _ in 0..(seconds * 1000.0).round() as usize {
        let before = plant.velocities();
        plant.advance(1e-3);
        for ((v, v0), p) in plant.velocities().iter().zip(before).zip(plant.positions()) {
            assert!(v.abs() <= 1.0 + 1e-9, "velocity {v}");
            let most = if plant.drive() == Drive::Servo { 20.0 } else { 10.0 };
            assert!((v - v0).abs() <= most * 1e-3 + 1e-9, "acceleration {}", (v - v0) / 1e-3);
            assert!(p.abs() <= 2.0, "position {p}");
        }
        each(plant);
    }
}

#[test]
fn position_moves_on_a_trapezoid_and_lands_exactly() {
    let mut plant = plant(Tracking::Lag(0.02));
    plant.move_to(&[1.5, -0.49], 0.5);
    let mut top: f64 = 0.0;
    run(&mut plant, 2.5, |p| top = top.max(p.velocities()[0]));
    assert!((top - 0.5).abs() < 1e-9, "half speed: {top}");
    assert_eq!(plant.positions()[..2], [1.5, -0.49]);
    assert_eq!(plant.velocities()[..2], [0.0, 0.0]);
    assert!(!plant.moving());
}

#[test]
fn a_lagging_servo_follows_a_ramp_one_time_constant_behind() {
    let mut plant = plant(Tracking::Lag(0.02));
    let mut target = 0.5;
    for _ in 0..100 {
        target += 0.5 * 0.01;
        plant.servo(&[target, -0.5]);
        run(&mut plant, 0.01, |_| ());
    }
    let behind = target - plant.positions()[0];
    assert!((0.002..0.02).contains(&behind), "behind by {behind}");
    run(&mut plant, 1.0, |_| ());
    assert_eq!(plant.positions()[..2], [target, -0.5]);
}

#[test]
fn a_lagging_servo_keeps_up_at_speed_and_stops_with_its_setpoints() {
    // 10 times the speed up to which braking for each setpoint would still keep up.
    let limits = JointLimits { acceleration_max: vec![10.0; 2], ..JointLimits::uniform(2, 9.0, 3.0) };
    let mut plant = Plant::new(&limits, &[0.0, 0.0], Tracking::Lag(0.02), 0.0);
    plant.enable(true);
    let (mut target, mut speed, mut worst) = (0.0, 0.0_f64, 0.0_f64);
    for tick in 0..150 {
        speed = if tick < 75 { (speed + 0.08).min(2.8) } else { (speed - 0.08).max(0.0) };
        target += speed * 0.01;
        plant.servo(&[target, 0.0]);
        plant.advance(0.01);
        worst = worst.max((target - plant.positions()[0]).abs());
        assert!(plant.positions()[0] < target + 1e-3, "it overshoots");
    }
    assert!((0.03..0.09).contains(&worst), "20 ms and half a period behind at 2.8 rad/s: {worst}");
    plant.advance(0.5);
    assert_eq!(plant.positions()[0], target);
}

#[test]
fn an_ideal_servo_is_there_at_once_within_its_speed() {
    let mut plant = plant(Tracking::Ideal);
    plant.advance(0.01);
    plant.servo(&[0.505, -0.5]);
    assert_eq!(plant.positions()[0], 0.505);
    assert!((plant.velocities()[0] - 0.5).abs() < 1e-9);
    plant.advance(0.01);
    plant.servo(&[0.605, -0.5]);
    assert!((plant.positions()[0] - 0.515).abs() < 1e-9, "10 ms at 1 rad/s, not further");
    plant.advance(0.05);
    assert!((plant.positions()[0] - 0.565).abs() < 1e-9, "continues at top speed");
    plant.servo(&[0.605, -0.5]);
    assert!((plant.positions()[0] - 0.565).abs() < 1e-9, "travel time counts only once");
    plant.advance(1.0);
    assert_eq!((plant.positions()[0], plant.velocities()[0]), (0.605, 0.0));
}

#[test]
fn velocity_integrates_stops_at_limits_and_stop_decelerates() {
    let mut ideal = plant(Tracking::Ideal);
    ideal.velocity(&[0.25, -9.0]);
    ideal.advance(1.0);
    assert!((ideal.positions()[0] - 0.75).abs() < 1e-9 && (ideal.positions()[1] + 1.5).abs() < 1e-9);
    let mut lagging = plant(Tracking::Lag(0.02));
    lagging.velocity(&[1.0, -1.0]);
    run(&mut lagging, 3.0, |_| ());
    assert!((lagging.positions()[0] - 2.0).abs() < 1e-3, "brakes before its limit");
    lagging.velocity(&[-1.0, 0.0]);
    run(&mut lagging, 0.5, |_| ());
    lagging.stop();
    run(&mut lagging, 0.11, |_| ());
    assert_eq!(lagging.velocities()[..2], [0.0, 0.0], "1 rad/s at 10 rad/s² takes 0.1 s");
}

#[test]
fn disabled_holds_with_brakes_and_falls_without() {
    let mut braked = plant(Tracking::Ideal);
    braked.enable(false);
    braked.servo(&[0.0, 0.0]);
    braked.advance(1.0);
    assert_eq!(braked.positions()[..2], [0.5, -0.5]);
    let mut falling = Plant::new(&JointLimits::uniform(2, 2.0, 1.0), &[0.5, -0.5], Tracking::Ideal, 0.2);
    falling.advance(1.0);
    assert!((falling.positions()[0] - 0.3).abs() < 1e-9);
    falling.advance(100.0);
    assert_eq!(falling.positions()[..2], [-2.0, -2.0]);
    falling.falls(0.5, &[None, Some(1.0)]);
    falling.advance(1.0);
    assert!((falling.positions()[1] + 1.5).abs() < 1e-9);
    falling.advance(100.0);
    assert_eq!((falling.positions()[0], falling.positions()[1]), (-2.0, 1.0), "friction holds the first");
    assert!(!falling.moving());
}

#[test]
fn sag_and_block_disturb_one_joint() {
    let mut plant = plant(Tracking::Lag(0.02));
    plant.sag(0.05);
    plant.block(0, true);
    plant.advance(1.0);
    assert!((plant.positions()[1] + 0.55).abs() < 1e-9);
    plant.move_to(&[0.0, 0.0], 1.0);
    plant.advance(3.0);
    assert_eq!(plant.positions()[..2], [0.5, 0.0]);
}

#[test]
fn nonsense_moves_nothing() {
    let mut plant = plant(Tracking::Ideal);
    plant.servo(&[f64::NAN, f64::INFINITY]);
    plant.advance(f64::NAN);
    plant.advance(-1.0);
    plant.advance(0.1);
    plant.velocity(&[f64::NAN]);
    plant.advance(0.1);
    assert_eq!(plant.positions()[..2], [0.5, -0.5]);
}

#[test]
fn a_planned_move_never_passes_its_target() {
    for i in (1..400).step_by(7) {
        let target = 0.5 + 0.0031 * f64::from(i);
        let mut plant = plant(Tracking::Lag(0.02));
        plant.move_to(&[target, -0.5], 0.9);
        let mut k = 0;
        while plant.moving() {
            k += 1;
            plant.advance(1e-4 * (1.0 + 0.37 * f64::from(k % 3)));
            let over = plant.positions()[0] - target;
            assert!(over < 1e-9, "{over:e} past {target}");
        }
        plant.advance(1e-3);
        assert_eq!(plant.positions()[0], target);
    }
}

#[test]
fn a_dead_time_delays_setpoints_and_a_stop_discards_them() {
    let limits = JointLimits { acceleration_max: vec![10.0; 2], ..JointLimits::uniform(2, 2.0, 1.0) };
    let mut plant = Plant::lagging(&limits, &[0.5, -0.5], 0.1);
    plant.servo(&[0.6, -0.5]);
    plant.enable(true);
    plant.advance(0.2);
    assert_eq!(plant.positions()[0], 0.5, "the motors were off");
    plant.servo(&[0.6, -0.5]);
    plant.advance(0.079);
    assert_eq!(plant.positions()[0], 0.5, "80 ms of dead time");
    plant.advance(0.004);
    assert!(plant.positions()[0] > 0.5);
    plant.servo(&[0.7, -0.5]);
    plant.stop();
    plant.advance(1.0);
    assert!((0.5..0.51).contains(&plant.positions()[0]) && !plant.moving(), "{}", plant.positions()[0]);
    plant.servo(&[0.7, -0.5]);
    plant.advance(0.05);
    plant.move_to(&[0.4, -0.5], 1.0);
    plant.advance(1.0);
    assert_eq!(plant.positions()[0], 0.4);
}

/// What continues without setpoints goes `v·T + v²/2a` past the last one, and lags by its lag before.
#[test]
fn a_reference_continues_for_its_time_and_then_decelerates() {
    let limits = JointLimits { acceleration_max: vec![10.0; 2], ..JointLimits::uniform(2, 3.0, 3.0) };
    let mut plant = Plant::lagging(&limits, &[0.0, 0.0], 0.06).as_controlled(4.0, 0.04);
    plant.enable(true);
    let (speed, period) = (0.2, 0.005);
    for i in 0..200 {
        plant.servo(&[speed * period * f64::from(i), 0.0]);
        plant.advance(period);
    }
    let last = speed * period * 199.0;
    // A setpoint holds for a period, and is in the middle of it on average.
    let behind = (last + 0.5 * speed * period - plant.positions()[0]) / speed;
    assert!((behind - 0.06).abs() < 0.003, "{behind}");
    plant.advance(2.0);
    let past = plant.positions()[0] - last;
    assert!((past - (speed * 0.04 + speed * speed / 8.0)).abs() < 2e-4, "{past}");
    assert_eq!(plant.velocities()[0], 0.0);
}

#[test]
fn a_pushed_joint_is_beside_its_place_and_commanded_ones_are_not() {
    let mut plant = Plant::lagging(&JointLimits::uniform(2, 3.0, 3.0), &[0.5, 0.0], 0.01);
    plant.enable(true);
    plant.nudge(Some((0, 0.01)));
    assert!((plant.positions()[0] - 0.51).abs() < 1e-9 && (plant.commanded()[0] - 0.5).abs() < 1e-9);
    plant.nudge(None);
    assert!((plant.positions()[0] - 0.5).abs() < 1e-9);
}
