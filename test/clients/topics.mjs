// SPDX-License-Identifier: BSD-3-Clause
// Topics: what programs with roslib do with them. See run.mjs.

import { collect, once } from './wait.mjs';

const COUNT = { name: '/robot/count', messageType: 'std_msgs/Int32' };

// The first message of each of some topics, with one compression: {topic: message}.
export async function receive(page, { topics, compression }) {
  const ros = await page.connect();
  const received = await Promise.all(Object.entries(topics).map(async ([name, messageType]) => {
    const [message] = await collect(new page.roslib.Topic({ ros, name, messageType, compression }), 1);
    return [name, message];
  }));
  return Object.fromEntries(received);
}

// So many messages of one topic, and when they came, in ms.
export async function listen(page, { topic, count }) {
  const ros = await page.connect();
  const times = [];
  const listener = new page.roslib.Topic({ ros, ...topic });
  listener.on('message', () => times.push(performance.now()));
  const messages = await collect(listener, count);
  return { messages, times };
}

// Two callbacks of one Topic; the second is taken off after some messages, then the first and with it the subscription.
export async function twoCallbacks(page) {
  const ros = await page.connect();
  const topic = new page.roslib.Topic({ ros, ...COUNT });
  const second = [];
  const takeSecond = (message) => second.push(message.data);
  topic.subscribe(takeSecond);
  const first = await new Promise((resolve) => {
    const messages = [];
    const takeFirst = (message) => {
      messages.push(message.data);
      if (messages.length === 5) topic.unsubscribe(takeSecond);
      if (messages.length === 10) {
        topic.unsubscribe(takeFirst);
        resolve(messages);
      }
    };
    topic.subscribe(takeFirst);
  });
  return { first, second };
}

// Subscribes, and unsubscribes without naming a callback; when told, subscribes again with the same Topic.
export async function again(page) {
  const ros = await page.connect();
  const topic = new page.roslib.Topic({ ros, ...COUNT });
  const before = await new Promise((resolve) => topic.subscribe((message) => resolve(message.data)));
  topic.unsubscribe();
  page.say({ unsubscribed: before });
  await page.told();
  topic.removeAllListeners('message');
  const after = await new Promise((resolve) => topic.subscribe((message) => resolve(message.data)));
  return { before, after };
}

// Three Topics for one topic, one of them throttled hard, which is taken back later.
export async function severalTopics(page) {
  const ros = await page.connect();
  const make = (more) => new page.roslib.Topic({ ros, ...COUNT, ...more });
  const slow = make({ throttle_rate: 60000 });
  const received = { slow: [], quick: [], other: [] };
  slow.subscribe((message) => received.slow.push(message.data));
  await once(slow, 'message');
  const other = make({ queue_length: 10 });
  other.subscribe((message) => received.other.push(message.data));
  received.quick = (await collect(make({}), 5)).map((message) => message.data); // unsubscribed when it has them
  const gotSlow = received.slow.length;
  slow.unsubscribe();
  const after = (await collect(make({}), 5)).map((message) => message.data);
  return { ...received, gotSlow, after };
}

// Publishes each of some messages on a topic of its own, at once.
export async function publish(page, { messages }) {
  const ros = await page.connect();
  for (const { topic, type, message } of messages) {
    new page.roslib.Topic({ ros, name: topic, messageType: type }).publish(page.message(message));
  }
  await page.call(ros, '/rosapi/get_time', 'rosapi/GetTime'); // all before it is handled by now
}

// Publishes without advertising, as programs do that write operations themselves; the type is what the topic has.
export async function publishBare(page, { topic, message }) {
  const ros = await page.connect();
  ros.callOnConnection({ op: 'publish', topic, msg: message });
  await page.call(ros, '/rosapi/get_time', 'rosapi/GetTime');
}

// A latched publisher: who comes later gets its last message, and nobody once it is unadvertised.
export async function latch(page, { name }) {
  const [ros, other] = [await page.connect(), await page.connect()];
  const options = { name, messageType: 'std_msgs/String' };
  const topic = new page.roslib.Topic({ ros, ...options, latch: true });
  topic.advertise();
  topic.publish(page.message({ data: 'first' }));
  topic.publish(page.message({ data: 'last' }));
  // Connections don't wait for each other; on one connection everything is in order.
  await collect(new page.roslib.Topic({ ros, ...options }), 1);
  const [late] = await collect(new page.roslib.Topic({ ros: other, ...options }), 1);
  page.say({ published: late.data });
  await page.told();
  topic.unadvertise();
  page.say({ unadvertised: name });
  await page.told();
}

// Messages from one connection to another, in order, while a third listens with CBOR.
export async function betweenClients(page, { name, count }) {
  const [sender, reader, third] = await Promise.all([page.connect(), page.connect(), page.connect()]);
  const options = { name, messageType: 'std_msgs/Int32', queue_length: count };
  const topic = new page.roslib.Topic({ ros: sender, ...options });
  topic.advertise();
  const received = await Promise.all([[reader, 'none'], [third, 'cbor']].map(([ros, compression]) => page.live(
    ros,
    1,
    () => ({ messages: collect(new page.roslib.Topic({ ros, ...options, compression }), count) }),
  )));
  for (let number = 0; number < count; number++) topic.publish(page.message({ data: number }));
  return Promise.all(received.map(async ({ messages }) => (await messages).map((message) => message.data)));
}

// What a program learns of its mistakes, at the default level and at "warning".
export async function mistakes(page, { topic }) {
  const ros = await page.connect();
  const statuses = [];
  const emit = ros.emit;
  ros.emit = (name, ...values) => {
    if (/^status(:|$)/.test(name)) statuses.push(values[0]);
    return emit.call(ros, name, ...values);
  };
  const pose = new page.roslib.Topic({ ros, name: topic, messageType: 'geometry_msgs/Pose' });
  pose.publish(page.message({ position: { x: 1 } })); // fields left out: a warning, which is not asked for
  pose.publish(page.message({ position: { x: 'one' } }));
  new page.roslib.Topic({ ros, name: topic, messageType: 'std_msgs/String' }).advertise();
  new page.roslib.Topic({ ros, name: '/nobody', messageType: 'no_such_package/Type' }).advertise();
  await page.call(ros, '/rosapi/get_time', 'rosapi/GetTime');
  const errors = statuses.splice(0);
  ros.setStatusLevel('warning', 'level');
  pose.publish(page.message({ position: { x: 2 } }));
  await page.call(ros, '/rosapi/get_time', 'rosapi/GetTime');
  return { errors, warnings: statuses };
}
