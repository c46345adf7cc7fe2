//! Requests that command the arm, and what the run replies. Targets of streams are sent without waiting, as soon as
//! they arrive; of those that the run has no room for, only the newest is kept, as the box does.

use std::collections::VecDeque;

use serde_json::Value;

use super::run_link::{Shared, code};
use dimos_arms::xarm::emulator::{JOINT_LIMIT, Refusal};
use dimos_rpc::api::{Method, Move, Servo, Velocity};
use dimos_rpc::client::{ClientError, Sender};
use dimos_rpc::{Code, RpcError};

/// Maximum number of targets that the run has not answered: fewer than it reads.
const MAX_UNANSWERED: usize = 16;

/// Target of a stream.
#[derive(Debug, Clone)]
pub enum Target {
    /// Of the servo task.
    Positions(Servo),
    /// Of the velocity task.
    Velocities(Velocity),
}

impl Target {
    fn send(&self, to: &mut Sender) -> Result<u64, ClientError> {
        match self {
            Self::Positions(target) => to.send(target),
            Self::Velocities(target) => to.send(target),
        }
    }
}

/// The connection that commands the arm.
#[derive(Debug)]
pub struct Commands {
    sender: Sender,
    /// The request whose reply a client waits for, and the reply.
    asked: Option<Asked>,
    answer: Option<Result<Value, RpcError>>,
    /// Targets without a reply, the oldest first.
    unanswered: VecDeque<u64>,
    /// The newest target that waits for room.
    newest: Option<Target>,
    /// Why a target was refused.
    refused: Option<RpcError>,
}

/// A request whose reply a client waits for.
#[derive(Debug, PartialEq, Eq)]
struct Asked {
    id: u64,
    method: &'static str,
    params: String,
}

impl Commands {
    pub fn new(sender: Sender) -> Self {
        Self { sender, asked: None, answer: None, unanswered: VecDeque::new(), newest: None, refused: None }
    }

    pub fn close(&self) {
        self.sender.close();
    }

    /// Sends a request; its reply matters only if it is an error.
    pub fn send<M: Method>(&mut self, params: &M, shared: &Shared) {
        if let Err(error) = self.sender.send(params) {
            shared.lose(error);
        }
    }

    /// Makes a request, and returns its reply once it has come. Until then, call it again with the same parameters.
    pub fn ask<M: Method>(&mut self, params: &M, shared: &Shared) -> Result<M::Reply, Refusal> {
        let text = serde_json::to_string(params).unwrap_or_default();
        if let Some(asked) = &self.asked {
            let same = asked.method == M::NAME && asked.params == text;
            // The reply to a move is for the client that made it.
            let Some(answer) = self.answer.take_if(|_| same || asked.method != Move::NAME) else {
                return Err(Refusal::Pending);
            };
            self.asked = None;
            if same {
                let reply = answer.and_then(|reply| {
                    serde_json::from_value(reply).map_err(|e| RpcError::new(Code::Internal, e.to_string()))
                });
                return reply.map_err(|error| {
                    shared.note(format!("{} refused: {error}", M::NAME));
                    refusal(&error)
                });
            }
        }
        match self.sender.send(params) {
            Ok(id) => self.asked = Some(Asked { id, method: M::NAME, params: text }),
            Err(error) => {
                shared.lose(error);
                return Err(Refusal::NotNow);
            }
        }
        Err(Refusal::Pending)
    }

    /// Returns whether a move is under way that the run has not answered, or whose reply no client has taken yet.
    pub fn is_asking_for_move(&self) -> bool {
        self.asked.as_ref().is_some_and(|asked| asked.method == Move::NAME)
    }

    /// Forgets such a move. Returns whether there is one.
    pub fn forget_move(&mut self) -> bool {
        let found = self.is_asking_for_move();
        if found {
            (self.asked, self.answer) = (None, None);
        }
        found
    }

    /// Sends a target, or keeps it until the run has room.
    pub fn stream(&mut self, target: Target, shared: &Shared) {
        if self.unanswered.len() >= MAX_UNANSWERED {
            self.newest = Some(target);
            return;
        }
        match target.send(&mut self.sender) {
            Ok(id) => self.unanswered.push_back(id),
            Err(error) => shared.lose(error),
        }
    }

    /// Ends the stream: nothing that waits is sent.
    pub fn end_stream(&mut self) {
        self.newest = None;
    }

    /// Takes why the run has refused a target.
    pub fn take_refused(&mut self) -> Option<RpcError> {
        self.refused.take()
    }

    /// Takes a reply of the run.
    pub fn take_reply(&mut self, id: u64, result: Result<Value, RpcError>, shared: &Shared) {
        if self.asked.as_ref().is_some_and(|asked| asked.id == id) {
            self.answer = Some(result);
        } else if let Some(at) = self.unanswered.iter().position(|target| *target == id) {
            self.unanswered.remove(at);
            if let Err(error) = result {
                self.refused.get_or_insert(error);
                self.newest = None;
            }
            if let Some(target) = self.newest.take() {
                self.stream(target, shared);
            }
        } else if let Err(error) = result {
            shared.note(format!("the run refused a request: {error}"));
        }
    }
}

/// Returns what the controller answers to a request that the run has refused.
pub fn refusal(error: &RpcError) -> Refusal {
    match error.code {
        Code::OutOfLimits => Refusal::Error(JOINT_LIMIT),
        Code::StartStateMismatch | Code::OutOfReach => Refusal::Error(code::SPEED),
        Code::ArmLatched => Refusal::Error(code::STOP_INPUT),
        Code::NoTrajectoryTask => Refusal::Error(code::PLANNING),
        Code::ArmNotReady | Code::StillFaulted | Code::ShuttingDown => Refusal::NotNow,
        _ => Refusal::Error(code::REFUSED),
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader, Lines};
    use std::os::unix::net::{UnixListener, UnixStream};

    use serde_json::json;

    use super::*;
    use dimos_rpc::client::Client;

    /// A connection, and the lines that the run receives.
    fn connected() -> (Commands, Client, Lines<BufReader<UnixStream>>, Shared) {
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("s");
        let listener = UnixListener::bind(&socket).unwrap();
        let client = Client::connect("test", &socket).unwrap();
        let (run, _) = listener.accept().unwrap();
        let commands = Commands::new(client.sender().unwrap());
        (commands, client, BufReader::new(run).lines(), Shared::new("arm", [None, None]))
    }

    fn target(position: f64) -> Target {
        Target::Positions(Servo::new("servo_arm", vec![position]))
    }

    fn next(lines: &mut Lines<BufReader<UnixStream>>) -> Value {
        serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap()
    }

    #[test]
    fn of_targets_that_the_run_has_no_room_for_the_newest_is_sent() {
        let (mut commands, _client, mut lines, shared) = connected();
        (0..MAX_UNANSWERED + 5).for_each(|i| commands.stream(target(i as f64), &shared));
        let first: Vec<Value> = (0..MAX_UNANSWERED).map(|_| next(&mut lines)).collect();
        let id = first[0]["id"].as_u64().unwrap();
        commands.take_reply(id, Ok(json!({})), &shared);
        assert_eq!(next(&mut lines)["params"]["positions"][0], (MAX_UNANSWERED + 4) as f64);
        let refused = RpcError::new(Code::StartStateMismatch, "too far");
        commands.stream(target(99.0), &shared);
        commands.take_reply(id + 1, Err(refused.clone()), &shared);
        assert_eq!(commands.take_refused(), Some(refused));
        commands.take_reply(id + 2, Ok(json!({})), &shared);
        commands.stream(target(1.0), &shared);
        assert_eq!(next(&mut lines)["params"]["positions"][0], 1.0, "a refused stream sends nothing that waited");
    }

    #[test]
    fn a_reply_is_for_the_request_that_asked_for_it() {
        let (mut commands, _client, mut lines, shared) = connected();
        let go = |to: f64| Move::new("arm", [to], 1.0);
        assert_eq!(commands.ask(&go(0.1), &shared), Err(Refusal::Pending));
        assert_eq!(commands.ask(&go(0.1), &shared), Err(Refusal::Pending), "it is sent once");
        let id = next(&mut lines)["id"].as_u64().unwrap();
        let reply = json!({"motion": 7, "task": "t", "duration": 1.0, "joints": [], "start": [], "target": []});
        commands.take_reply(id, Ok(reply), &shared);
        assert!(commands.is_asking_for_move());
        assert_eq!(commands.ask(&go(0.2), &shared), Err(Refusal::Pending), "another client's waits");
        assert_eq!(commands.ask(&go(0.1), &shared).unwrap().motion, 7);
        assert_eq!(commands.ask(&go(0.2), &shared), Err(Refusal::Pending));
        let second = next(&mut lines);
        assert_eq!((second["params"]["target"][0].as_f64(), second["id"].as_u64()), (Some(0.2), Some(id + 1)));
        commands.take_reply(id + 1, Err(RpcError::new(Code::OutOfLimits, "beyond")), &shared);
        assert_eq!(commands.ask(&go(0.2), &shared), Err(Refusal::Error(JOINT_LIMIT)));
        assert_eq!(shared.take_notes(), ["move refused: beyond"]);
    }

    #[test]
    fn a_forgotten_move_is_asked_for_again() {
        let (mut commands, _client, mut lines, shared) = connected();
        let go = Move::new("arm", [0.1], 1.0);
        assert_eq!(commands.ask(&go, &shared), Err(Refusal::Pending));
        let id = next(&mut lines)["id"].as_u64().unwrap();
        assert!(commands.forget_move() && !commands.forget_move());
        commands.take_reply(id, Err(RpcError::new(Code::AlreadyExecuting, "late")), &shared);
        assert_eq!(commands.ask(&go, &shared), Err(Refusal::Pending), "the late reply is not its own");
        assert_eq!(next(&mut lines)["id"], id + 1);
    }
}
