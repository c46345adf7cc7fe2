//! `dimos share`: gives a run to other computers, where `--at` reaches it. `dimos run` starts it for a blueprint with a
//! section `share`.

use std::path::{Path, PathBuf};
use std::process::exit;
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::{Signal, set_parent_process_death_signal};
use serde_json::json;

use super::exit::{Exit, Failure, Result};
use super::output;
use super::text_log::Terminal;
use crate::blueprint::share::{ANYONE, Distro, Endpoint, Identity, OnLost, Role, RosConfig, ShareConfig, is_ros_name};
use crate::share::{Gateway, refusals};
use dimos_rpc::client;
use dimos_rpc::client::ClientError;
use dimos_rpc::run_dir::RunDir;

/// Time in which a face joins its router, if that is there.
const JOIN_TIMEOUT: Duration = Duration::from_secs(1);

/// Arguments of `share`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Without certificates only this computer is served: tcp/127.0.0.1:7447, and who connects has the role of the user `-`, by \
default observer. Everywhere else the network is encrypted and both ends show certificates: docs/many-machines.md shows \
how to make them. A stop over a network is even less a safety function than a local one.")]
pub struct Args {
    /// The run to share; needed only when several are live
    #[arg(long, value_name = "RUN")]
    run: Option<String>,
    /// Listen here: tls/0.0.0.0:7447, or tcp/127.0.0.1:7447 (repeatable)
    #[arg(long, value_name = "ENDPOINT", required_unless_present_any = ["connect", "ros", "config"])]
    listen: Vec<Endpoint>,
    /// Join the router there (repeatable)
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<Endpoint>,
    /// Folder with ca.pem, and NAME.pem and NAME.key of this computer
    #[arg(long, value_name = "DIR")]
    identity: Option<PathBuf>,
    /// Role of the user with this common name, or of `-`, who has no certificate: observer, planner, operator, owner
    /// (repeatable)
    #[arg(long, value_name = "NAME=ROLE", value_parser = user, allow_hyphen_values = true)]
    user: Vec<(String, Role)>,
    /// Allow tcp/ beyond this computer: not encrypted, and open to everyone who reaches it
    #[arg(long)]
    insecure: bool,
    /// What becomes of the motions of a commander that is lost
    #[arg(long, value_name = "WHAT", default_value = "cancel", value_parser = on_lost)]
    on_lost: OnLost,
    /// Let operators reset and enable arms from other computers
    #[arg(long)]
    remote_enable: bool,
    /// Be the node `dimos` of ROS 2, through the router of rmw_zenoh: tcp/127.0.0.1:7447, or this one
    #[arg(long, value_name = "ROUTER", num_args = 0..=1)]
    ros: Option<Option<Endpoint>>,
    /// Domain of ROS 2
    #[arg(long, value_name = "NUMBER", default_value_t = 0, env = "ROS_DOMAIN_ID", value_parser = clap::value_parser!(u32).range(0..=232))]
    ros_domain: u32,
    /// Namespace of the node of ROS 2
    #[arg(long, value_name = "NAME", default_value = "", hide_default_value = true, value_parser = namespace)]
    ros_namespace: String,
    /// Distribution of the other nodes of ROS 2: jazzy, kilted, lyrical
    #[arg(long, value_name = "DISTRO", default_value = "jazzy", value_parser = distro)]
    ros_distro: Distro,
    /// Let ROS move arms: every node that reaches the router can then
    #[arg(long)]
    command: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// The section of a blueprint, as `dimos run` gives it to its gateway, which ends with it
    #[arg(long, hide = true, value_parser = config, conflicts_with_all = ["listen", "connect", "identity", "user"])]
    config: Option<ShareConfig>,
}

fn user(text: &str) -> std::result::Result<(String, Role), String> {
    let names: Vec<&str> = Role::ALL.iter().map(|role| role.name()).collect();
    let wrong = || format!("must be NAME=ROLE; roles: {}", names.join(", "));
    let (name, role) = text.split_once('=').ok_or_else(wrong)?;
    Ok((name.to_owned(), Role::of_name(role).ok_or_else(wrong)?))
}

fn namespace(text: &str) -> std::result::Result<String, String> {
    let name = text.trim_matches('/');
    let good = name.is_empty() || is_ros_name(name);
    good.then(|| name.to_owned()).ok_or_else(|| "has letters, digits and '_', in parts separated by '/'".to_owned())
}

fn distro(text: &str) -> std::result::Result<Distro, String> {
    let names: Vec<&str> = Distro::ALL.iter().map(|distro| distro.name()).collect();
    Distro::of_name(text).ok_or_else(|| format!("must be one of {}", names.join(", ")))
}

fn on_lost(text: &str) -> std::result::Result<OnLost, String> {
    OnLost::of_name(text).ok_or_else(|| "must be cancel or finish".to_owned())
}

fn config(text: &str) -> std::result::Result<ShareConfig, String> {
    serde_json::from_str(text).map_err(|e| e.to_string())
}

impl Args {
    fn config(&self) -> Result<ShareConfig> {
        if let Some(config) = &self.config {
            return Ok(config.clone());
        }
        if self.command && self.ros.is_none() {
            let failure = Failure::usage("--command lets ROS move arms, and it is not served");
            return Err(failure.hint("add --ros; users of an endpoint get a role: --user NAME=operator"));
        }
        Ok(ShareConfig {
            listen: self.listen.clone(),
            connect: self.connect.clone(),
            insecure: self.insecure,
            identity: self.identity.as_deref().map(identity).transpose()?,
            users: self.user.iter().cloned().collect(),
            on_lost: self.on_lost,
            remote_enable: self.remote_enable,
            ros: self.ros.as_ref().map(|router| RosConfig {
                router: router.clone().unwrap_or_else(|| RosConfig::default().router),
                domain: self.ros_domain,
                namespace: self.ros_namespace.clone(),
                distro: self.ros_distro,
                command: self.command,
            }),
            ..ShareConfig::default()
        })
    }
}

/// Returns the certificate of a folder: that of the only private key in it.
fn identity(folder: &Path) -> Result<Identity> {
    let entries = std::fs::read_dir(folder).map_err(|e| Failure::usage(format!("{}: {e}", folder.display())))?;
    let keys = entries.flatten().map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|e| e == "key"));
    match keys.collect::<Vec<_>>().as_slice() {
        [key] => Ok(Identity { ca: folder.join("ca.pem"), cert: key.with_extension("pem"), key: key.clone() }),
        found => {
            let failure = Failure::usage(format!("{} has {} private keys, not one", folder.display(), found.len()));
            Err(failure.hint("it has ca.pem, and NAME.pem and NAME.key of this computer"))
        }
    }
}

/// Runs the verb: serves until the run ends, or a signal.
pub fn run(args: &Args) -> Result {
    let config = args.config()?;
    let is_child = args.config.is_some();
    if is_child {
        // The run may be killed; nothing of it is then to remain.
        let _ = set_parent_process_death_signal(Some(Signal::TERM));
    }
    let refusals = |terminal: &Terminal| {
        let terminal = terminal.clone();
        Some(refusals(&config, move |line| terminal.note(format_args!("warning: {line}"))))
    };
    let _terminal = Terminal::start_with(refusals).map_err(|e| Failure::new(Exit::Failed, e.to_string()))?;
    let folder = RunDir::standard();
    let found = client::find(&folder, args.run.as_deref())?;
    let gateway = Gateway::start(&found.name, folder.lasting(&found), config.clone()).map_err(ClientError::from)?;
    if !is_child {
        // The gateway of a blueprint continues to serve what else it has.
        if let Some(error) = gateway.bridge_error() {
            return Err(ClientError::from(error.clone()).into());
        }
        let endpoints: Vec<String> = config.listen.iter().chain(&config.connect).map(ToString::to_string).collect();
        match args.json {
            true => {
                let mut shared = json!({"event": "shared", "run": found.name, "endpoints": endpoints});
                if let Some(face) = &config.ros {
                    shared["ros"] = json!({"router": face.router, "domain": face.domain, "command": face.command});
                }
                output::json(&shared);
            }
            false => {
                output::note(format_args!("run {} is shared:", found.name));
                lines(&config).iter().for_each(|line| output::note(format_args!("  {line}")));
                output::note("Press Ctrl-C to end that; the run continues.");
            }
        }
        let began = Instant::now();
        while !gateway.not_serving().is_empty() && began.elapsed() < JOIN_TIMEOUT {
            sleep(Duration::from_millis(10));
        }
        gateway.not_serving().iter().for_each(|what| output::note(format_args!("warning: {what}")));
    }
    gateway.serve();
    if is_child {
        // Its threads may wait for the network.
        exit(0);
    }
    output::note(format_args!("run {} has ended", found.name));
    Ok(Exit::Ok)
}

/// Returns a line for each endpoint, with who may do what there.
pub(super) fn lines(config: &ShareConfig) -> Vec<String> {
    let of = |tls: bool| {
        let users = config.users.iter().filter(|(name, _)| (name.as_str() != ANYONE) == tls);
        let mut text: Vec<String> = users.map(|(name, role)| format!("{name} {}", role.name())).collect();
        if !tls {
            let role = config.users.get(ANYONE).copied().unwrap_or(Role::Observer);
            text = vec![format!("everyone who reaches it is {}", role.name())];
        }
        if text.is_empty() { "no users: no one can connect".to_owned() } else { text.join(", ") }
    };
    let line = |verb: &str, endpoint: &Endpoint| {
        let open = if endpoint.tls || endpoint.is_loopback() { "" } else { "NOT ENCRYPTED, " };
        format!("{verb} {endpoint}: {open}{}", of(endpoint.tls))
    };
    let listen = config.listen.iter().map(|endpoint| line("at", endpoint));
    let mut lines: Vec<String> =
        listen.chain(config.connect.iter().map(|endpoint| line("through", endpoint))).collect();
    if let Some(face) = &config.ros {
        let who = if face.command { "EVERY NODE THAT REACHES THE ROUTER MAY MOVE THE ARMS" } else { reads(config) };
        let domain = if face.domain == 0 { String::new() } else { format!(", domain {}", face.domain) };
        let distro = face.distro.name();
        lines.push(format!("with ROS 2 {distro} through {}{domain}: {who}", face.router));
    }
    lines
}

/// Returns what a face does that may not command.
fn reads(config: &ShareConfig) -> &'static str {
    if config.observers_stop { "reads, and ends motion" } else { "reads" }
}
