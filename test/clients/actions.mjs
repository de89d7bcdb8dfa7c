// SPDX-License-Identifier: BSD-3-Clause
// Actions, as roslib does them over topics. See run.mjs.

import { collect, once } from './wait.mjs';

const ACTION = 'actionlib/TestAction';

function client(page, ros, serverName, more = {}) {
  return new page.roslib.ActionClient({ ros, serverName, actionName: ACTION, ...more });
}

// A goal that has been sent; `outcome` resolves to what came of it.
function send(page, actionClient, goal, timeout) {
  const sent = new page.roslib.Goal({ actionClient, goalMessage: { goal } });
  const feedback = [];
  const statuses = [];
  sent.on('feedback', (message) => feedback.push(message.feedback));
  sent.on('status', (status) => statuses.at(-1) === status.status || statuses.push(status.status));
  sent.outcome = once(sent, 'result').then((result) => ({
    result: result.result,
    status: sent.status.status,
    feedback,
    statuses,
  }));
  sent.send(timeout);
  return sent;
}

// One goal, carried out; then another with the same client.
export async function carryOut(page, { server, goals }) {
  const ros = await page.connect();
  const actionClient = await page.live(ros, 3, () => client(page, ros, server)); // to miss no feedback
  const outcomes = [];
  for (const goal of goals) outcomes.push(await send(page, actionClient, goal).outcome);
  actionClient.dispose();
  return outcomes;
}

// A goal that is cancelled on its first feedback, alone or with all others.
export async function cancel(page, { server, all }) {
  const ros = await page.connect();
  const actionClient = client(page, ros, server);
  const goal = send(page, actionClient, 1000);
  await once(goal, 'feedback');
  (all ? actionClient : goal).cancel();
  return goal.outcome;
}

// A goal that takes too long for the program, which then cancels it.
export async function goalTimeout(page, { server }) {
  const ros = await page.connect();
  const goal = send(page, client(page, ros, server), 1000, 300);
  await once(goal, 'timeout');
  const before = goal.feedback.feedback;
  goal.cancel();
  return { before, outcome: await goal.outcome };
}

// The client's timeout comes when there is no server, and doesn't when there is one, whose time is over first.
export async function serverTimeout(page, { server, nobody }) {
  const ros = await page.connect();
  const timedOut = [];
  client(page, ros, server, { timeout: 1000 }).on('timeout', () => timedOut.push(server));
  await once(client(page, ros, nobody, { timeout: 1000 }), 'timeout');
  return timedOut;
}

// Two goals that run at once; the first is cancelled, which is nothing to the second.
export async function twoAtOnce(page, { server }) {
  const ros = await page.connect();
  const actionClient = client(page, ros, server);
  const first = send(page, actionClient, 1000);
  const second = send(page, actionClient, 10);
  await Promise.all([once(first, 'feedback'), once(second, 'feedback')]);
  first.cancel();
  return Promise.all([first.outcome, second.outcome]);
}

// Another program watches what goes on.
export async function watch(page, { server }) {
  const [ros, other] = [await page.connect(), await page.connect()];
  const seen = { goals: [], feedback: [], results: [] };
  const listener = await page.live(
    other,
    4,
    () => new page.roslib.ActionListener({ ros: other, serverName: server, actionName: ACTION }),
  );
  const goal = once(listener, 'goal');
  const told = new Promise((resolve) => {
    listener.on('feedback', ({ feedback }) => {
      seen.feedback.push(feedback);
      if (feedback === 3) resolve();
    });
  });
  const result = once(listener, 'result');
  const { outcome } = send(page, client(page, ros, server), 3);
  seen.results.push((await result).result);
  seen.goals.push((await goal).goal.goal); // there is no order among topics: this may come last, or the feedback
  await told;
  await outcome;
  return seen;
}

// An action server in the program, which the robot, a ROS node, uses.
export async function serve(page, { server }) {
  const ros = await page.connect();
  const actionServer = new page.roslib.SimpleActionServer({ ros, serverName: server, actionName: ACTION });
  // ROS's client drops feedback that comes before it has noted down its own goal: told again until it is heard.
  let current = null;
  let telling = null;
  const end = (how) => {
    clearInterval(telling);
    current = null;
    how();
  };
  actionServer.on('goal', ({ goal }) => {
    const tell = () => actionServer.sendFeedback({ feedback: goal * 10 });
    current = goal;
    telling = setInterval(tell, 100);
    tell();
  });
  // The robot tells that it has the feedback; a result that overtook it would make it void.
  const noted = new page.roslib.Topic({ ros, name: '/robot/goal_feedback', messageType: 'std_msgs/Int32' });
  noted.subscribe(({ data }) => {
    if (current === null || data !== current * 10) return;
    if (data === 30) end(() => actionServer.setSucceeded({ result: 6 }));
    if (data === 40) end(() => actionServer.setAborted({ result: 0 }));
  });
  actionServer.on('cancel', () => end(() => actionServer.setPreempted()));
  const answerTo = `${server}/outcomes`;
  const ask = new page.roslib.Topic({ ros, name: '/robot/send_goals', messageType: 'std_msgs/String' });
  ask.publish(page.message({ data: JSON.stringify({ server, goals: [3, 4, 5], answer_to: answerTo }) }));
  const [outcomes] = await collect(new page.roslib.Topic({ ros, name: answerTo, messageType: 'std_msgs/String' }), 1);
  return JSON.parse(outcomes.data);
}
