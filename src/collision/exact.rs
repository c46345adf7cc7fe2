//! The exact checker: every solid against every other, in double precision, with balls around links to rule out most.

use std::sync::Arc;

use glamx::{DAffine3, DVec3};

use crate::robot::model::Limits;

use super::checker::{CollisionChecker, Resolution, Verdict};
use super::pairs::general::nearest;
use super::pairs::{self, point};
use super::report::{Contact, Pair};
use super::scene::{LinkShape, Scene};

/// Checks configurations of one scene. Allocates nothing while it looks.
#[derive(Debug, Clone)]
pub struct ExactChecker {
    scene: Arc<Scene>,
    resolution: Resolution,
    frames: Vec<DAffine3>,
    /// Middles of the balls around the links, in the world's frame.
    centers: Vec<DVec3>,
    /// Pairs of things that never move and touch: no configuration is free.
    always: Option<Pair>,
    /// Order of the links: those that move most, first.
    order: Vec<usize>,
    /// What touched last: likely to touch again.
    witness: Option<Pair>,
}

impl ExactChecker {
    /// A checker of a scene.
    pub fn new(scene: Arc<Scene>, resolution: Resolution) -> Self {
        let frames = scene.frames();
        let mut order: Vec<usize> = (0..scene.links.len()).filter(|&l| scene.links[l].moves).collect();
        order.reverse();
        let centers = vec![DVec3::ZERO; scene.links.len()];
        let mut made = Self { scene, resolution, frames, centers, always: None, order, witness: None };
        made.place(&vec![0.0; made.scene.dof()]);
        let scene = made.scene.clone();
        let still = |pair: &Pair| match *pair {
            Pair::Links(a, b) => !scene.links[a].moves && !scene.links[b].moves,
            Pair::Obstacle(link, _) => !scene.links[link].moves,
        };
        made.always = scene.all_pairs().filter(still).find(|pair| made.touches(*pair, 0.0));
        made
    }

    /// The scene it checks.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// Moves all frames and balls to a configuration.
    fn place(&mut self, q: &[f64]) {
        self.scene.forward(q, &mut self.frames);
        for (center, link) in self.centers.iter_mut().zip(&self.scene.links) {
            *center = self.frames[link.frame].transform_point3(link.ball.0);
        }
    }

    /// Whether two things are within a margin of each other, where they stand now.
    fn touches(&self, pair: Pair, margin: f64) -> bool {
        match pair {
            Pair::Links(a, b) => self.links_touch(a, b, margin),
            Pair::Obstacle(link, obstacle) => self.obstacle_touches(link, obstacle, margin),
        }
    }

    fn obstacle_touches(&self, link: usize, obstacle: usize, margin: f64) -> bool {
        let (link, standing) = (&self.scene.links[link], &self.scene.obstacles[obstacle]);
        let frame = &self.frames[link.frame];
        let other = standing.placed();
        let (guard, half) = &standing.guard;
        link.solids.iter().any(|solid| {
            let reach = solid.radius + standing.solid.radius + margin;
            let placed = solid.place(frame);
            // The obstacle's box first: most of a link's solids are far from it.
            let near = match &placed {
                pairs::Placed::Point(p) => outside(*p, guard, *half) <= reach * reach,
                _ => true,
            };
            near && pairs::within(&placed, &other, reach)
        })
    }

    fn links_touch(&self, a: usize, b: usize, margin: f64) -> bool {
        let (first, second) = (&self.scene.links[a], &self.scene.links[b]);
        let (f, g) = (&self.frames[first.frame], &self.frames[second.frame]);
        let ball = (self.centers[b], second.ball.1);
        first.solids.iter().any(|one| {
            let placed = one.place(f);
            if let pairs::Placed::Point(p) = placed {
                let reach = one.radius + margin + ball.1;
                if p.distance_squared(ball.0) > reach * reach {
                    return false;
                }
            }
            second.solids.iter().any(|two| pairs::within(&placed, &two.place(g), one.radius + two.radius + margin))
        })
    }

    /// Looks at all pairs where things stand now; `margins` gives the margin of a link and of a pair.
    fn search(&self, margin: Option<&[f64]>) -> Verdict {
        let scene = &*self.scene;
        let mut close = false;
        let of = |levers: &[f64], close: bool| match margin {
            Some(margin) if !close => levers.iter().zip(margin).map(|(l, m)| l * m).sum(),
            _ => 0.0,
        };
        for &l in &self.order {
            let link = &scene.links[l];
            let mut extra: f64 = of(&link.levers, close);
            for (o, obstacle) in scene.obstacles.iter().enumerate() {
                let reach = link.ball.1 + obstacle.solid.radius + extra;
                if outside(self.centers[l], &obstacle.guard.0, obstacle.guard.1) > reach * reach
                    || scene.allowed[l][o]
                    || !self.obstacle_touches(l, o, extra)
                {
                    continue;
                }
                if extra == 0.0 || self.obstacle_touches(l, o, 0.0) {
                    return Verdict::Hit(Pair::Obstacle(l, o));
                }
                (close, extra) = (true, 0.0);
            }
        }
        for pair in &scene.pairs {
            let (a, b) = (&scene.links[pair.a], &scene.links[pair.b]);
            let extra: f64 = of(&pair.levers, close);
            let reach = a.ball.1 + b.ball.1 + extra;
            if self.centers[pair.a].distance_squared(self.centers[pair.b]) > reach * reach
                || !self.links_touch(pair.a, pair.b, extra)
            {
                continue;
            }
            if extra == 0.0 || self.links_touch(pair.a, pair.b, 0.0) {
                return Verdict::Hit(Pair::Links(pair.a, pair.b));
            }
            close = true;
        }
        if close { Verdict::Close } else { Verdict::Free }
    }

    fn contact(&self, pair: Pair) -> Option<Contact> {
        let scene = &*self.scene;
        let (l, name) = match pair {
            Pair::Links(a, b) => (a, &scene.links[b].name),
            Pair::Obstacle(l, o) => (l, &scene.obstacles[o].name),
        };
        let link = &scene.links[l];
        let mut best: Option<Contact> = None;
        let mut see = |one: &super::Solid, other: &pairs::Placed, radius: f64| {
            let found = nearest(&one.place(&self.frames[link.frame]), other);
            let distance = found.distance - one.radius - radius;
            if best.as_ref().is_none_or(|b| distance < b.distance) {
                let towards = (found.b - found.a).normalize_or_zero() * found.distance.signum();
                let (on_link, on_other) = (found.a + towards * one.radius, found.b - towards * radius);
                let (link, other) = (link.name.clone(), name.clone());
                best = Some(Contact { pair, link, other, distance, on_link, on_other });
            }
        };
        for one in &link.solids {
            match pair {
                Pair::Links(_, b) => {
                    let LinkShape { solids, frame, .. } = &scene.links[b];
                    solids.iter().for_each(|two| see(one, &two.place(&self.frames[*frame]), two.radius));
                }
                Pair::Obstacle(_, o) => see(one, &scene.obstacles[o].placed(), scene.obstacles[o].solid.radius),
            }
        }
        best
    }
}

/// Squared distance of a point from a box.
fn outside(p: DVec3, frame: &DAffine3, half: DVec3) -> f64 {
    (point::local(p, frame).abs() - half).max(DVec3::ZERO).length_squared()
}

impl Scene {
    /// Every pair that is checked.
    pub fn all_pairs(&self) -> impl Iterator<Item = Pair> + '_ {
        let obstacle = move |l: usize| {
            let checked = move |o: &usize| !self.allowed[l][*o];
            (0..self.obstacles.len()).filter(checked).map(move |o| Pair::Obstacle(l, o))
        };
        let links = self.pairs.iter().map(|p| Pair::Links(p.a, p.b));
        (0..self.links.len()).flat_map(obstacle).chain(links)
    }
}

impl CollisionChecker for ExactChecker {
    fn dof(&self) -> usize {
        self.scene.dof()
    }

    fn limits(&self) -> &[Limits] {
        self.scene.limits()
    }

    fn resolution(&self) -> Resolution {
        self.resolution
    }

    fn look(&mut self, q: &[f64], margin: Option<&[f64]>) -> Verdict {
        if let Some(pair) = self.always {
            return Verdict::Hit(pair);
        }
        self.place(q);
        if let Some(pair) = self.witness
            && self.touches(pair, 0.0)
        {
            return Verdict::Hit(pair);
        }
        let verdict = self.search(margin);
        if let Verdict::Hit(pair) = verdict {
            self.witness = Some(pair);
        }
        verdict
    }

    fn reach(&self, motion: &[f64]) -> f64 {
        let of = |levers: &[f64]| levers.iter().zip(motion).map(|(l, m)| l * m.abs()).sum::<f64>();
        let links = self.scene.links.iter().map(|l| of(&l.levers));
        links.chain(self.scene.pairs.iter().map(|p| of(&p.levers))).fold(0.0, f64::max)
    }

    fn clearance(&mut self, q: &[f64]) -> Option<Contact> {
        self.place(q);
        let mut best: Option<Contact> = None;
        for pair in self.scene.clone().all_pairs() {
            // A ball around each says "farther than the best" for most pairs.
            let (l, other) = match pair {
                Pair::Links(a, b) => (a, self.centers[a].distance(self.centers[b]) - self.scene.links[b].ball.1),
                Pair::Obstacle(l, o) => {
                    let standing = &self.scene.obstacles[o];
                    let gap = outside(self.centers[l], &standing.guard.0, standing.guard.1).sqrt();
                    (l, gap - standing.solid.radius)
                }
            };
            let least = other - self.scene.links[l].ball.1;
            if best.as_ref().is_none_or(|b| least < b.distance)
                && let Some(contact) = self.contact(pair)
                && best.as_ref().is_none_or(|b| contact.distance < b.distance)
            {
                best = Some(contact);
            }
        }
        best
    }

    fn contacts(&mut self, q: &[f64]) -> Vec<Contact> {
        self.place(q);
        let scene = self.scene.clone();
        let touching = scene.all_pairs().filter(|pair| self.touches(*pair, 0.0));
        let mut contacts: Vec<Contact> = touching.filter_map(|pair| self.contact(pair)).collect();
        contacts.sort_by(|a, b| a.distance.total_cmp(&b.distance));
        contacts
    }
}
