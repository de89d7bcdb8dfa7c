// SPDX-License-Identifier: BSD-3-Clause
// Connections: their events, and what goes on after one is lost. See run.mjs.

import { collect, once } from './wait.mjs';

// Opens, calls, closes, and opens the same Ros again.
export async function openAndClose(page) {
  const events = [];
  const ros = await page.connect();
  ros.on('connection', () => events.push('connection'));
  ros.on('close', () => events.push('close'));
  ros.authenticate('mac', '127.0.0.1', '127.0.0.1', 'rand', 1, 'user', 2); // accepted while authentication is off
  const before = await page.call(ros, '/rosapi/has_param', 'rosapi/HasParam', { name: '/rosdistro' });
  events.push(ros.isConnected);
  const closed = once(ros, 'close');
  ros.close();
  await closed;
  events.push(ros.isConnected);
  const opened = once(ros, 'connection');
  ros.connect(page.url);
  await opened;
  events.push(ros.isConnected);
  const after = await page.call(ros, '/rosapi/has_param', 'rosapi/HasParam', { name: '/rosdistro' });
  return { events: [...events], before, after };
}

// Subscribes, publishes and provides; when the connection is lost, connects again until it holds, as programs do. The
// same Topics go on; the service is advertised again by the program.
export async function reconnect(page, { hears, says, provides }) {
  const ros = await page.connect();
  ros.on('error', () => {}); // refused while the bridge is down
  const listener = new page.roslib.Topic({ ros, name: hears, messageType: 'std_msgs/Int32' });
  const talker = new page.roslib.Topic({ ros, name: says, messageType: 'std_msgs/String', latch: true });
  const provide = () => {
    const service = new page.roslib.Service({ ros, name: provides, serviceType: 'rosbridge_library/AddTwoInts' });
    service.advertise((request, response) => {
      response.sum = request.a + request.b;
      return true;
    });
  };
  let received = 0;
  listener.subscribe(() => {
    received += 1;
    if (received === 1) page.say({ received });
  });
  talker.publish(page.message({ data: 'before' }));
  provide();
  await once(listener, 'message');
  const lost = once(ros, 'close');
  page.say({ connected: true });
  await lost;
  const atLoss = received;
  ros.on('close', () => setTimeout(() => ros.connect(page.url), 50));
  const back = once(ros, 'connection');
  setTimeout(() => ros.connect(page.url), 50);
  await back;
  ros.removeAllListeners(provides);
  provide();
  await once(listener, 'message');
  talker.publish(page.message({ data: 'after' }));
  page.say({ back: { atLoss, received } });
  await page.told();
  ros.removeAllListeners('close');
}

// A large message through a bridge with settings of its own.
export async function large(page, { topic }) {
  const ros = await page.connect();
  const [message] = await collect(new page.roslib.Topic({ ros, name: topic, messageType: 'std_msgs/String' }), 1);
  const answer = await page.call(ros, '/robot/send_bytes', 'rosbridge_library/SendBytes', { count: 100000 });
  return { received: message.data.length, answered: answer.data.length };
}
